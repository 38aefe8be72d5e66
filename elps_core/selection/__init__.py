"""Which algorithm renders: candidates, trials that measure them, and the race that decides."""
