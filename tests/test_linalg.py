import numpy as np
import pytest
import scipy.linalg
import torch
from scipy.stats import multivariate_normal, multivariate_t

from torch_pbd.exceptions import NotPositiveDefiniteError
from torch_pbd.linalg import (
    cholesky_with_jitter,
    least_eigenvalue,
    log_density,
    rows_below,
    safe_cholesky,
    scale_tril_from_root,
    spectral_map,
    symmetrize,
    tril_to_vector,
    vector_to_tril,
)


def randn(*shape, generator):
    return torch.randn(*shape, dtype=torch.float64, generator=generator)


@pytest.mark.parametrize("d", [1, 2, 9])
def test_packing_a_triangle_and_unpacking_it_is_the_identity(d, generator):
    factor = randn(4, 3, d, d, generator=generator).tril()
    vector = tril_to_vector(factor)
    assert vector.shape == (4, 3, d * (d + 1) // 2)
    assert torch.equal(vector_to_tril(vector), factor)


def test_packing_goes_row_by_row():
    factor = torch.tensor([[1.0, 0.0], [2.0, 3.0]], dtype=torch.float64)
    assert tril_to_vector(factor).tolist() == [1.0, 2.0, 3.0]


def test_unpacking_is_differentiable(generator):
    vector = randn(2, 6, generator=generator).requires_grad_()
    assert torch.autograd.gradcheck(vector_to_tril, vector)


@pytest.mark.parametrize("d", [9, 10, 11, 13])
def test_symmetrize_is_symmetric_to_the_last_bit(d, generator):
    factor = randn(50, d, d, generator=generator).tril()
    covariance = symmetrize(factor @ factor.mT)
    assert torch.equal(covariance, covariance.mT)


@pytest.mark.parametrize(("d", "rank"), [(1, 3), (2, 2), (9, 20)])
def test_the_factor_of_a_root_is_that_of_cholesky(d, rank, generator):
    root = randn(5, d, rank, generator=generator)
    torch.testing.assert_close(scale_tril_from_root(root), torch.linalg.cholesky(root @ root.mT), rtol=1e-9, atol=1e-11)


def test_the_factor_of_a_root_keeps_small_variances_that_a_product_would_lose():
    small = 1e-12
    root = torch.tensor([[1.0, 0.0], [1.0, small]], dtype=torch.float64)
    assert scale_tril_from_root(root)[1, 1].item() == pytest.approx(small, rel=1e-9)
    assert torch.linalg.cholesky_ex(root @ root.mT).info > 0


@pytest.mark.parametrize("rank", [0, 1, 2])
def test_a_root_of_low_rank_gives_a_singular_factor_and_no_failure(rank, generator):
    root = randn(4, 3, rank, generator=generator)
    factor = scale_tril_from_root(root)
    torch.testing.assert_close(factor @ factor.mT, root @ root.mT, rtol=0, atol=1e-12)
    assert (factor.diagonal(dim1=-2, dim2=-1) >= 0).all()


def test_the_factor_of_a_root_is_differentiable(generator):
    root = randn(3, 2, 4, generator=generator).requires_grad_()
    assert torch.autograd.gradcheck(scale_tril_from_root, root)


def test_cholesky_adds_no_jitter_where_none_is_needed(generator):
    root = randn(6, 4, 9, generator=generator)
    factor, jitter = cholesky_with_jitter(root @ root.mT, name="matrix")
    assert jitter == 0.0
    assert torch.equal(factor, torch.linalg.cholesky(root @ root.mT))


@pytest.mark.parametrize("scale", [1e-18, 1.0, 1e18])
def test_jitter_is_relative_and_only_where_it_is_needed(scale):
    singular = scale * torch.ones(3, 3, dtype=torch.float64)
    regular = scale * torch.eye(3, dtype=torch.float64)
    factor, jitter = cholesky_with_jitter(torch.stack([singular, regular]), name="matrix")
    assert 0 < jitter <= 1e-12
    torch.testing.assert_close(factor[0] @ factor[0].mT, singular, rtol=1e-11, atol=0)
    assert torch.equal(factor[1], torch.linalg.cholesky(regular))


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        ([[1.0, 2.0], [2.0, 1.0]], "the prior is not positive definite"),
        ([[1.0, np.nan], [np.nan, 1.0]], "finite"),
    ],
)
def test_what_is_not_positive_definite_is_an_error_that_names_it(matrix, message):
    with pytest.raises(NotPositiveDefiniteError, match=message):
        safe_cholesky(torch.tensor(matrix, dtype=torch.float64), name="the prior")


@pytest.mark.parametrize("d", [1, 2, 9])
def test_log_density_is_that_of_scipy(d, generator):
    root, residual = randn(d, d + 2, generator=generator), randn(7, d, generator=generator)
    covariance = root @ root.mT
    factor = torch.linalg.cholesky(covariance).expand(7, d, d)
    expected = multivariate_normal(cov=covariance.numpy()).logpdf(residual.numpy())
    np.testing.assert_allclose(log_density(residual, factor), expected.ravel(), rtol=1e-9)


@pytest.mark.parametrize("degrees", [2.1, 3.0, 17.5, 1e4])
@pytest.mark.parametrize("d", [1, 2, 9])
def test_students_log_density_is_that_of_scipy(d, degrees, generator):
    """Whose shape matrix is the covariance times ``(degrees - 2) / degrees``."""
    root, residual = randn(d, d + 2, generator=generator), 3.0 * randn(7, d, generator=generator)
    covariance = root @ root.mT
    factor = torch.linalg.cholesky(covariance).expand(7, d, d)
    peer = multivariate_t(np.zeros(d), covariance.numpy() * (degrees - 2.0) / degrees, df=degrees)
    found = log_density(residual, factor, torch.full((7,), degrees, dtype=torch.float64))
    np.testing.assert_allclose(found, np.atleast_1d(peer.logpdf(residual.numpy())), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("degrees", [1e6, 1e8, 1e12, np.inf])
def test_of_many_degrees_students_density_is_the_normal(degrees, generator):
    """They differ by a term of the order of the squared distance, here up to 90, squared over the degrees."""
    residual = 3.0 * randn(50, 3, generator=generator)
    factor = torch.eye(3, dtype=torch.float64).expand(50, 3, 3)
    found = log_density(residual, factor, torch.full((50,), degrees, dtype=torch.float64))
    error = (found - log_density(residual, factor)).abs().max()
    assert error < 1e4 / min(degrees, 1e7)
    assert error < 1e-2


def test_students_log_density_is_differentiable(generator):
    residual = randn(4, 2, generator=generator).requires_grad_()
    factor = (randn(4, 2, 2, generator=generator).tril(-1) + torch.eye(2)).requires_grad_()
    degrees = torch.tensor([2.5, 4.0, 30.0, 1e3], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(log_density, (residual, factor, degrees))


def test_the_gradient_through_a_jittered_factor_is_finite():
    """Of the log determinant, by Jacobi's formula: the inverse of the matrix that was factorized."""
    matrix = torch.ones(2, 2, dtype=torch.float64).requires_grad_()
    factor, jitter = cholesky_with_jitter(matrix[None], name="matrix")
    (gradient,) = torch.autograd.grad(2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(), matrix)
    inverse = torch.linalg.inv(matrix.detach() + jitter * torch.eye(2).to(matrix))
    torch.testing.assert_close(gradient, inverse, rtol=0.1, atol=0.0)  # the condition number is 1e14


def with_eigenvalues(values, generator, dtype=torch.float64):
    """Symmetric matrix of these eigenvalues and random axes."""
    axes = torch.linalg.qr(randn(len(values), len(values), generator=generator)).Q
    return symmetrize(axes * torch.tensor(values, dtype=torch.float64) @ axes.mT).to(dtype)


@pytest.mark.parametrize("d", [1, 2, 9])
def test_spectral_maps_are_the_matrix_functions_of_scipy(d, generator):
    root = randn(3, 4, d, d + 2, generator=generator)
    matrix = root @ root.mT / d
    for function, expected in {torch.exp: scipy.linalg.expm, torch.sqrt: scipy.linalg.sqrtm}.items():
        result = spectral_map(matrix, function)
        assert torch.equal(result, result.mT)
        for each, reference in zip(result.flatten(0, 1), matrix.flatten(0, 1), strict=True):
            reference = expected(reference.numpy())
            np.testing.assert_allclose(each, reference, rtol=1e-9, atol=1e-11 * abs(reference).max())


@pytest.mark.parametrize("values", [[1.0, 2.0, 5.0], [0.6, 0.0, 0.6], [3.0, 3.0, 3.0], [2.0], [0.0, 0.0]])
def test_gradients_of_spectral_maps_survive_equal_eigenvalues(values, generator):
    for matrix in (with_eigenvalues(values, generator), torch.diag(torch.tensor(values, dtype=torch.float64))):
        assert torch.autograd.gradcheck(lambda m: spectral_map(m, torch.exp), matrix.requires_grad_())


@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float64, 1e-7), (torch.float32, 1e-3)])
@pytest.mark.parametrize("gap", [0.0, 1e-14, 1e-10, 3e-8, 3e-6, 1e-5, 1e-4, 1e-2])
def test_gradients_of_nearly_equal_eigenvalues_are_the_frechet_derivative(gap, dtype, rtol, generator):
    """Half the digits of the type are left: a quotient of tiny differences, or a mean slope, must keep them."""
    for _ in range(20):
        matrix = with_eigenvalues([1.0, 1.0 + gap, 2.0], generator, dtype).requires_grad_()
        weight = symmetrize(randn(3, 3, generator=generator)).to(dtype)
        (gradient,) = torch.autograd.grad((weight * spectral_map(matrix, torch.exp)).sum(), matrix)
        exact = (matrix.detach().double().numpy(), weight.double().numpy())
        expected = scipy.linalg.expm_frechet(*exact, compute_expm=False)
        np.testing.assert_allclose(gradient, expected, rtol=0, atol=rtol * abs(expected).max())


def test_second_derivatives_of_spectral_maps_are_an_error_and_not_silently_wrong():
    matrix = torch.eye(2, dtype=torch.float64).requires_grad_()
    with pytest.raises(RuntimeError, match="no second derivatives"):
        torch.autograd.grad(spectral_map(matrix, torch.exp).sum(), matrix, create_graph=True)


def test_the_least_of_many_eigenvalues_is_that_of_scipy(generator):
    """At an end of two of a batch, where one row in a hundred is far below the others, and all rows above another."""
    root = randn(2, 300, 4, 4, generator=generator)
    matrix, relative_to = symmetrize(root), root @ root.mT + torch.eye(4).double()
    matrix[1, 123] -= 50.0 * torch.eye(4)
    pairs = zip(matrix.flatten(0, 1).numpy(), relative_to.flatten(0, 1).numpy(), strict=True)
    values = np.reshape([scipy.linalg.eigh(*pair, eigvals_only=True)[0] for pair in pairs], (2, 300)).min(0)

    def pencil(rows, q, p):
        return q * matrix[:, rows] + p * relative_to[:, rows]

    least, row = least_eigenvalue(pencil, 300)
    assert (least, row) == (pytest.approx(values.min(), rel=1e-9), 123)
    limit = np.median(values)
    assert rows_below(pencil, limit, 300).tolist() == np.flatnonzero(values < limit).tolist()
