"""Events along trajectories, and the system over stretches from event to event.

- ``event_crossings``: where paths cross the roots of functions: all of a stack at once
- ``event_integration``: roots of functions along trajectories, events that end or reset them, and
  flows between
- ``event_trajectory``: a trajectory with its events, and what events do at an instant
- ``forced``: trajectories that follow an order of events, whether it holds or not
- ``markers``: levels of states at which stretches end, on oscillators that get out of phase and
  on fronts that many trajectories meet after the horizon
- ``openings``: events that trajectories meet just before a turn, or miss where they turn too
  early
- ``orders``: orders of events that hold in parts of a box, each continued to all of it
- ``periods``: periods that repeat: an autonomous oscillator that has come back goes on as it went
  before
- ``sides``: the order of events in a box, and systems on the sides of their switches
- ``stretch_integrator``: trajectories over the pseudo-time of stretches, integrated over clock
  time
- ``stretches``: trajectories over stretches: from event to event, each in a time of its own
"""
