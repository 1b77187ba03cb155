"""Events along trajectories, and the system over stretches from event to event.

======================  =====================================================================
``event_trajectory``    a trajectory with events: what it has met, and what it has ahead
``instants``            what events do at one instant, and what they trigger
``crossings``           where paths cross the roots of functions, all of a stack at once
``integration``         roots of functions along trajectories, which end them or reset states
``periods``             trajectories of oscillators that repeat, which are integrated no further
``event_order``         the order in which all trajectories of a box meet their events
``sides``               systems on given sides of switches, and whether trajectories stay on these
``stretches``           the system over stretches: from event to event, in pseudo-time
``over_stretches``      what trajectories over pseudo-time share
``stretch_integrator``  those that meet events in one order
``forced``              those that follow an order wherever it holds or not
``orders``              orders that hold in parts of a box, each continued to all of it
``openings``            events that trajectories meet just before they turn, or miss: continued too
``markers``             crossings that all pass in step, where they get out of phase
``late_fronts``         a crossing that all pass once, many of them after the horizon
======================  =====================================================================
"""
