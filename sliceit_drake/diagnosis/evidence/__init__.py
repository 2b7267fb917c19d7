"""What the residuals of records say of each cause, and the verdict."""
