import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from sonar_graph.numerics import mat3 as triples
from sonar_graph.numerics.mat3 import skew

vectors = st.tuples(*[st.floats(-10, 10)] * 3)
matrices = st.tuples(*[vectors] * 3)


def same(actual, expected):
    assert_allclose(actual, expected, atol=1e-10)


@given(vectors, vectors, st.floats(-10, 10))
def test_vectors_are_numpy_s(a, b, s):
    u, v = np.array(a), np.array(b)
    same(triples.dot(a, b), u @ v)
    same(triples.cross(a, b), np.cross(u, v))
    same(triples.plus(a, b), u + v)
    same(triples.minus(a, b), u - v)
    same(triples.scaled(s, a), s * u)
    assert triples.vector(u) == a


@given(matrices, matrices, vectors, vectors, st.floats(-10, 10))
def test_matrices_are_numpy_s(first, second, v, p, s):
    A, B = np.array(first), np.array(second)
    same(triples.times(first, v), A @ v)
    same(triples.transformed(p, first, v), np.array(p) + A @ v)
    same(triples.transposed(first), A.T)
    same(triples.product(first, second), A @ B)
    same(triples.gram(first), A @ A.T)
    same(triples.skew_times(v, first), skew(np.array(v)) @ A)
    same(triples.times_skew(first, v), A @ skew(np.array(v)))
    same(triples.sum_of(first, second), A + B)
    same(triples.difference_of(first, second), A - B)
    same(triples.multiple_of(s, first), s * A)
    same(triples.symmetric(first), 0.5 * (A + A.T))
    assert triples.matrix(A) == first


@given(matrices, matrices, matrices)
def test_a_sandwich_is_the_covariance_of_two_products(A, C, B):
    assert_allclose(triples.sandwich(A, C, B), np.array(A) @ np.array(C) @ np.array(B).T, atol=1e-9)


@given(matrices)
def test_what_should_be_symmetric_is_to_the_last_bit(A):
    for whole in (triples.gram(A), triples.symmetric(A)):
        assert_array_equal(np.array(whole), np.array(whole).T)


def test_a_matrix_is_placed_where_it_belongs():
    out, A = np.zeros((4, 5)), np.arange(1.0, 10).reshape(3, 3)
    triples.place(triples.matrix(A), out, 1, 2)
    assert_array_equal(out[1:, 2:], A)
    assert np.count_nonzero(out) == 9
