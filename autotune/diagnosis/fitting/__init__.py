"""Models fitted to recordings: noise, windows, free numbers, Gauss-Newton, restarts."""
