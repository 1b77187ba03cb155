"""What every room uses: errors, wording, files, progress, the budget of counted work."""
