"""Systems of fields, their trajectories one by one, and what is kept of these.

- ``field_system``: sparse operators and elementwise functions, as frozen data
"""
