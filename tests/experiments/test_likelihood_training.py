"""The benchmark of training on a likelihood: its three ways end at one optimum, preconditioned ones soon."""

import pytest
from speed import likelihood_training as benchmark


@pytest.mark.parametrize("seed", [0, 1])
def test_all_end_at_one_optimum_and_preconditioned_lbfgs_needs_few_evaluations(seed):
    result = benchmark.run(seed)
    for evaluations, seconds, above in result.values():
        assert evaluations > 0
        assert seconds > 0.0
        assert above < 1e-3
    counts = {name: evaluations for name, (evaluations, _, _) in result.items()}
    assert counts["Fisher scoring"] <= 10
    assert counts["preconditioned L-BFGS"] <= 25
    assert counts["whitened L-BFGS"] > 50
