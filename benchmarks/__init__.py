"""What lampopt reaches, measured: against the plain mix of distances, and against doing nothing."""
