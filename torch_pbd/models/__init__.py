"""Torch modules that predict a mean and a covariance; batched and differentiable."""
