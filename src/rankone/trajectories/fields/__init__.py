"""Systems of fields, their trajectories one by one, and what is kept of these.

- ``field_factors``: factors of the matrices of implicit steps
- ``field_system``: sparse operators and elementwise functions, as frozen data
- ``field_trajectories``: trajectories by backward differences with sparse matrices, compressed
  into modes as they come
"""
