"""Events along trajectories, and the system over stretches from event to event.

- ``event_crossings``: where paths cross the roots of functions: all of a stack at once
- ``event_integration``: roots of functions along trajectories, which end them or reset their
  states
- ``event_order``: the order in which the trajectories of a box meet their events, and what does
  not follow it
- ``event_trajectory``: a trajectory with events: what it has met, and what it still has ahead
- ``forced``: trajectories that follow an order of events, whether it holds or not
- ``instants``: what events do to trajectories at one instant, and what crosses zero there
- ``late_fronts``: a front that trajectories meet once, each at its own time and many of them
  after the horizon
- ``markers``: markers of oscillators: crossings that all trajectories pass in step, once they get
  out of phase
- ``openings``: events that trajectories meet just before a turn, or miss where they turn too
  early
- ``orders``: orders of events that hold in parts of a box, each continued to all of it
- ``periods``: periods that repeat: an autonomous oscillator that has come back goes on as it went
  before
- ``sides``: the sides of switches that stretches hold, and whether trajectories stay on them
- ``stretch_integrator``: trajectories over the pseudo-time of stretches, integrated over clock
  time
- ``stretches``: trajectories over stretches: from event to event, each in a time of its own
"""
