"""What samples, the control law, the residual and rows that were not fitted say."""
