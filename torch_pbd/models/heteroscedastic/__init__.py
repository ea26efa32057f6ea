"""Mean and covariance by latent Gaussian processes that are integrated out: the recommended model."""
