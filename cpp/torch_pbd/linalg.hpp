/// Vectors and small symmetric matrices of fixed size: nothing here allocates.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <utility>

namespace torch_pbd {

template <std::size_t N>
using Vector = std::array<double, N>;
/// Rows of a square matrix.
template <std::size_t N>
using Matrix = std::array<Vector<N>, N>;

template <class T, std::size_t N>
std::array<T, N> operator+(std::array<T, N> a, const std::array<T, N>& b) {
    for (std::size_t i = 0; i < N; ++i) a[i] = a[i] + b[i];
    return a;
}

template <class T, std::size_t N>
std::array<T, N> operator-(std::array<T, N> a, const std::array<T, N>& b) {
    for (std::size_t i = 0; i < N; ++i) a[i] = a[i] - b[i];
    return a;
}

template <class T, std::size_t N>
std::array<T, N> operator*(double factor, std::array<T, N> a) {
    for (T& part : a) part = factor * part;
    return a;
}

namespace linalg {

template <std::size_t N>
double dot(const Vector<N>& a, const Vector<N>& b) {
    double sum = 0.0;
    for (std::size_t i = 0; i < N; ++i) sum += a[i] * b[i];
    return sum;
}

/// Some of the components of a vector, from `begin` to before `end`.
struct Block {
    std::size_t begin, end;
};

/// Length of a block of a vector; infinite or NaN only where a component is.
template <std::size_t N>
double norm(const Vector<N>& a, Block block) {
    double square = 0.0, length = 0.0;
    for (std::size_t i = block.begin; i < block.end; ++i) square += a[i] * a[i];
    if (1e-280 < square && square < 1e280) return std::sqrt(square);
    // Squares have overflown, or lost digits.
    for (std::size_t i = block.begin; i < block.end; ++i) length = std::hypot(length, a[i]);
    return length;
}

template <std::size_t N>
double norm(const Vector<N>& a) {
    return norm(a, {0, N});
}

template <std::size_t N>
Vector<N> product(const Matrix<N>& a, const Vector<N>& x) {
    Vector<N> result;
    for (std::size_t i = 0; i < N; ++i) result[i] = dot(a[i], x);
    return result;
}

template <std::size_t N>
Matrix<N> transposed(const Matrix<N>& a) {
    Matrix<N> result;
    for (std::size_t i = 0; i < N; ++i)
        for (std::size_t j = 0; j < N; ++j) result[j][i] = a[i][j];
    return result;
}

template <std::size_t N>
Matrix<N> product(const Matrix<N>& a, const Matrix<N>& b) {
    Matrix<N> result{};
    for (std::size_t i = 0; i < N; ++i)
        for (std::size_t k = 0; k < N; ++k)
            for (std::size_t j = 0; j < N; ++j) result[i][j] += a[i][k] * b[k][j];
    return result;
}

/// A' A.
template <std::size_t N>
Matrix<N> squared(const Matrix<N>& a) {
    return product(transposed(a), a);
}

/// Largest entry of a matrix, in size.
template <std::size_t N>
double largest(const Matrix<N>& a) {
    double most = 0.0;
    for (const Vector<N>& row : a)
        for (const double entry : row) most = std::max(most, std::abs(entry));
    return most;
}

template <std::size_t N>
struct Eigen {
    Vector<N> values;
    Matrix<N> axes;  ///< each row an eigenvector of length 1
};

/// Eigenvalues, in no order, and eigenvectors of a symmetric matrix by cyclic Jacobi rotations.
template <std::size_t N>
Eigen<N> eigh(Matrix<N> a) {
    Matrix<N> axes{};
    for (std::size_t i = 0; i < N; ++i) axes[i][i] = 1.0;
    const double negligible = 1e-17 * largest(a);
    for (bool is_diagonal = false; !is_diagonal;) {
        is_diagonal = true;
        for (std::size_t p = 0; p < N; ++p) {
            for (std::size_t q = p + 1; q < N; ++q) {
                if (!(std::abs(a[p][q]) > negligible)) continue;
                is_diagonal = false;
                // Tangent of the smaller of the two angles that make this entry zero (Golub and Van Loan, 8.5.2).
                const double tau = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
                const double tangent = std::copysign(1.0, tau) / (std::abs(tau) + std::hypot(1.0, tau));
                const double cosine = 1.0 / std::hypot(1.0, tangent), sine = tangent * cosine;
                for (Vector<N>& row : a) {
                    const double left = row[p], right = row[q];
                    row[p] = cosine * left - sine * right;
                    row[q] = sine * left + cosine * right;
                }
                for (Matrix<N>* turned : {&a, &axes}) {
                    for (std::size_t i = 0; i < N; ++i) {
                        const double left = (*turned)[p][i], right = (*turned)[q][i];
                        (*turned)[p][i] = cosine * left - sine * right;
                        (*turned)[q][i] = sine * left + cosine * right;
                    }
                }
                a[p][q] = a[q][p] = 0.0;
            }
        }
    }
    Eigen<N> result{{}, axes};
    for (std::size_t i = 0; i < N; ++i) result.values[i] = a[i][i];
    return result;
}

/// exp(matrix) - 1 by Taylor series and doubling: without the 1, slow motions keep their digits beside fast ones.
template <std::size_t N>
Matrix<N> expm1(const Matrix<N>& matrix) {
    double size = 0.0;
    for (const Vector<N>& row : matrix) {
        double sum = 0.0;
        for (const double entry : row) sum += std::abs(entry);
        size = std::max(size, sum);
    }
    int exponent = 0;
    std::frexp(size, &exponent);
    const int doublings = std::max(0, exponent + 1);
    // The norm is now 1/2 at most, for which 14 terms have all digits.
    const Matrix<N> small = std::ldexp(1.0, -doublings) * matrix;
    Matrix<N> power = (1.0 / 14.0) * small;
    for (int order = 13; order > 0; --order) power = (1.0 / order) * (small + product(small, power));
    for (int i = 0; i < doublings; ++i) power = 2.0 * power + product(power, power);
    return power;
}

}  // namespace linalg
}  // namespace torch_pbd
