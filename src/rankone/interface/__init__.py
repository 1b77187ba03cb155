"""What users hold: compiled problems and solutions."""
