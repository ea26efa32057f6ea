"""Evidence by torch's own normal distribution, differentiable by autograd."""

import torch

from torch_pbd.kernels import correlation


def negative_log_evidence(observations, hyperparameters, kernel="squared_exponential"):
    """Of each process, in nats."""
    gram = correlation(observations.inputs, observations.inputs, hyperparameters.length_scale, kernel)
    noise = hyperparameters.noise_ratio[:, None] / observations.counts
    covariance = hyperparameters.amplitude.square()[:, None, None] * (gram + torch.diag_embed(noise))
    zero = torch.zeros_like(observations.targets)
    return -torch.distributions.MultivariateNormal(zero, covariance).log_prob(observations.targets)
