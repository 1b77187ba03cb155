"""Systems of fields, their trajectories one by one, and what is kept of these.

- ``field_crossings``: events along trajectories: where numbers cross zero, and what is reset
- ``field_factors``: factors of the matrices of implicit steps
- ``field_steps``: backward differences with sparse matrices, from event to event
- ``field_system``: sparse operators and elementwise functions, as frozen data
- ``field_trajectories``: trajectories compressed into modes as they come
"""
