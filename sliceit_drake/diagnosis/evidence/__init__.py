"""What the residuals of records say of each cause, from sensitivities to a verdict."""
