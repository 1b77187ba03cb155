"""Systems made to be got wrong, and the truth about them."""
