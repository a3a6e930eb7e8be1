"""One inertial step and one Doppler sample of joint preintegration: mean, covariance and derivatives.

All errors are in frame i: ``R_true = Exp(theta) R``, ``v + dv``, ``p + dp``, ``s + ds``. Over a step of duration dt
with constant rate and specific force f, ``G`` the integral and ``H`` the double integral of the rotation, and u the
velocity of the DVL in body axes::

    a = G f,  b = H f,  c = G u,    v <- v + a,    p <- p + v dt + b,    s <- s + c
    dv <- dv - [a]x theta,    dp <- dp + dv dt - [b]x theta,    ds <- ds - [c]x theta

Isotropic gyro noise stays isotropic: ``cov(theta) = n_g^2 t I``. A covariance with theta is a vector m,
``cov(dx, theta) = -[m]x``; that of two integrals x and y with increments a_x, a_y changes, with q the variance of theta
in the middle of the step, by::

    cov(dx, dy) <- cov(dx, dy) - (h_y a_x^T + a_y h_x^T) + (a_x . h_y + a_y . h_x) I,     h = m + q a / 2

A Doppler sample enters s by one weight matrix, ``cov(ds) += W_k Q_k W_k^T``. Rule "inertial", with z the velocity of
the IMU's point and w_k half of the two intervals at sample k: ``s = p + sum_k w_k (R_k z_k - v_k)``, in which gravity,
initial velocity and a constant accelerometer bias cancel. Other rules: ``s = sum_k W_k z_k``.
docs/theory/preintegration.md.
"""

from typing import NamedTuple

from sonar_graph.navigation.preintegration.recursion import SERIES_ANGLE2, rotation_series, sine_series
from sonar_graph.numerics import (
    IDENTITY,
    ZERO,
    ZEROS,
    Matrix,
    Vector,
    difference_of,
    dot,
    inlined,
    minus,
    multiple_of,
    plus,
    product,
    scaled,
    skew_times,
    sum_of,
    times,
    times_skew,
    transposed,
)


class Path(NamedTuple):
    """The mean, in frame i."""

    elapsed_s: float
    R: Matrix
    v: Vector
    p: Vector
    s: Vector


class Spread(NamedTuple):
    """Covariances; rows belong to the first letter, columns to the second."""

    mv: Vector
    mp: Vector
    ms: Vector
    vv: Matrix
    vp: Matrix
    pp: Matrix
    sv: Matrix
    sp: Matrix
    ss: Matrix


class Slopes(NamedTuple):
    """Derivatives by the biases of gyros (g) and accelerometers (a), the Doppler scale and the mounting."""

    M: Matrix
    """Integral of R: minus the derivative of theta by g and of v by a."""
    N: Matrix
    """Double integral of R: minus the derivative of p by a."""
    v_g: Matrix
    p_g: Matrix
    s_g: Matrix
    s_a: Matrix
    s_scale: Vector
    s_mounting: Matrix


class Push(NamedTuple):
    """The contribution of one step, in frame i."""

    dt: float
    turn: Matrix
    G: Matrix
    H: Matrix
    a: Vector
    b: Vector
    c: Vector


AT_REST = Path(0.0, IDENTITY, ZERO, ZERO, ZERO)
NO_SPREAD = Spread(ZERO, ZERO, ZERO, ZEROS, ZEROS, ZEROS, ZEROS, ZEROS, ZEROS)
NO_SLOPES = Slopes(ZEROS, ZEROS, ZEROS, ZEROS, ZEROS, ZEROS, ZERO, ZEROS)


@inlined
def push(R: Matrix, dt: float, rate: Vector, force: Vector) -> Push:
    """A step of constant rate and specific force; without a displacement."""
    phi = scaled(dt, rate)
    angle2 = dot(phi, phi)
    s1, s2, s3 = sine_series(angle2)
    s4 = (0.5 - s2) / angle2 if angle2 > SERIES_ANGLE2 else 1 / 24 - angle2 * (1 / 720 - angle2 / 40320)
    G = multiple_of(dt, product(R, rotation_series(phi, angle2, s2, s3)))
    H = multiple_of(0.5 * dt * dt, product(R, rotation_series(phi, angle2, 2.0 * s3, 2.0 * s4)))
    return Push(dt, rotation_series(phi, angle2, s1, s2), G, H, times(G, force), times(H, force), ZERO)


@inlined
def pushed_path(path: Path, by: Push) -> Path:
    """The mean after a step."""
    return Path(
        path.elapsed_s + by.dt,
        product(path.R, by.turn),
        plus(path.v, by.a),
        plus(plus(path.p, scaled(by.dt, path.v)), by.b),
        plus(path.s, by.c),
    )


@inlined
def pushed_spread(spread: Spread, by: Push, theta_variance: float, accel_psd: float) -> Spread:
    """The covariance after a step; the variance of theta is that in the middle of the step, rad²."""
    dt, half = by.dt, 0.5 * theta_variance
    mp = plus(spread.mp, scaled(dt, spread.mv))
    pp = sum_of(spread.pp, multiple_of(dt, sum_of(spread.vp, transposed(spread.vp))))
    pp = sum_of(pp, multiple_of(dt * dt, spread.vv))
    vp = sum_of(spread.vp, multiple_of(dt, spread.vv))
    sp = sum_of(spread.sp, multiple_of(dt, spread.sv))
    hv, hp, hs = plus(spread.mv, scaled(half, by.a)), plus(mp, scaled(half, by.b)), plus(spread.ms, scaled(half, by.c))
    noise = accel_psd * dt
    return Spread(
        plus(spread.mv, scaled(theta_variance, by.a)),
        plus(mp, scaled(theta_variance, by.b)),
        plus(spread.ms, scaled(theta_variance, by.c)),
        _coupled(spread.vv, by.a, hv, by.a, hv, noise),
        _coupled(vp, by.a, hv, by.b, hp, noise * dt / 2.0),
        _coupled(pp, by.b, hp, by.b, hp, noise * dt * dt / 3.0),
        _coupled(spread.sv, by.c, hs, by.a, hv, 0.0),
        _coupled(sp, by.c, hs, by.b, hp, 0.0),
        _coupled(spread.ss, by.c, hs, by.c, hs, 0.0),
    )


@inlined
def _coupled(P: Matrix, ax: Vector, hx: Vector, ay: Vector, hy: Vector, noise: float) -> Matrix:
    d = dot(ax, hy) + dot(ay, hx) + noise
    x, y, z = P
    return (
        (
            x[0] + d - hy[0] * ax[0] - ay[0] * hx[0],
            x[1] - hy[0] * ax[1] - ay[0] * hx[1],
            x[2] - hy[0] * ax[2] - ay[0] * hx[2],
        ),
        (
            y[0] - hy[1] * ax[0] - ay[1] * hx[0],
            y[1] + d - hy[1] * ax[1] - ay[1] * hx[1],
            y[2] - hy[1] * ax[2] - ay[1] * hx[2],
        ),
        (
            z[0] - hy[2] * ax[0] - ay[2] * hx[0],
            z[1] - hy[2] * ax[1] - ay[2] * hx[1],
            z[2] + d - hy[2] * ax[2] - ay[2] * hx[2],
        ),
    )


@inlined
def pushed_slopes(slopes: Slopes, by: Push) -> Slopes:
    """The derivatives after a step; the rotation's own change within it counts by its mean."""
    M, N, v_g, p_g, s_g, s_a, s_scale, s_mounting = slopes
    half, third = sum_of(M, multiple_of(0.5, by.G)), sum_of(M, multiple_of(1.0 / 3.0, by.G))
    N = sum_of(sum_of(N, multiple_of(by.dt, M)), by.H)
    p_g = sum_of(sum_of(p_g, multiple_of(by.dt, v_g)), skew_times(by.b, third))
    v_g, s_g = sum_of(v_g, skew_times(by.a, half)), sum_of(s_g, skew_times(by.c, half))
    return Slopes(sum_of(M, by.G), N, v_g, p_g, s_g, s_a, s_scale, s_mounting)


@inlined
def with_sample(
    path: Path, spread: Spread, slopes: Slopes, z: Vector, weight_s: float, gyro_psd: float
) -> tuple[Path, Spread, Slopes]:
    """Add ``w_k y_k`` with the error ``e = -w ([R z]x theta + dv)``; the sample's own noise is added elsewhere."""
    w, turned = weight_s, times(path.R, z)
    variance = gyro_psd * path.elapsed_s
    mv, mp, ms, vv, vp, pp, sv, sp, ss = spread
    by_v = _skew_product(turned, mv)
    e_v = multiple_of(-w, sum_of(by_v, vv))
    e_p = multiple_of(-w, sum_of(_skew_product(turned, mp), vp))
    e_s = multiple_of(-w, sum_of(_skew_product(turned, ms), transposed(sv)))
    e_e = difference_of(sum_of(by_v, transposed(by_v)), multiple_of(variance, _skew_product(turned, turned)))
    e_e = multiple_of(w * w, sum_of(e_e, vv))
    e_m = scaled(w, minus(scaled(variance, turned), mv))
    ss = sum_of(sum_of(ss, e_e), sum_of(e_s, transposed(e_s)))
    M, N, v_g, p_g, s_g, s_a, s_scale, s_mounting = slopes
    s_g = sum_of(s_g, multiple_of(w, difference_of(skew_times(turned, M), v_g)))
    s_a, s_scale = sum_of(s_a, multiple_of(w, M)), plus(s_scale, scaled(w, turned))
    s_mounting = difference_of(s_mounting, multiple_of(w, times_skew(path.R, z)))
    return (
        Path(path.elapsed_s, path.R, path.v, path.p, plus(path.s, scaled(w, minus(turned, path.v)))),
        Spread(mv, mp, plus(ms, e_m), vv, vp, pp, sum_of(sv, e_v), sum_of(sp, e_p), ss),
        Slopes(M, N, v_g, p_g, s_g, s_a, s_scale, s_mounting),
    )


@inlined
def _skew_product(a: Vector, b: Vector) -> Matrix:
    """``[a]x [b]x = b a^T - (a . b) I``."""
    d = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return (
        (b[0] * a[0] - d, b[0] * a[1], b[0] * a[2]),
        (b[1] * a[0], b[1] * a[1] - d, b[1] * a[2]),
        (b[2] * a[0], b[2] * a[1], b[2] * a[2] - d),
    )


@inlined
def with_inertial_position(path: Path, spread: Spread, slopes: Slopes) -> tuple[Path, Spread, Slopes]:
    """Add the inertial position at the end, ``s <- p + s``."""
    mv, mp, ms, vv, vp, pp, sv, sp, ss = spread
    M, N, v_g, p_g, s_g, s_a, s_scale, s_mounting = slopes
    sp_end = sum_of(pp, sp)
    ss_end = sum_of(sum_of(ss, transposed(sp)), sp_end)
    return (
        Path(path.elapsed_s, path.R, path.v, path.p, plus(path.p, path.s)),
        Spread(mv, mp, plus(mp, ms), vv, vp, pp, sum_of(transposed(vp), sv), sp_end, ss_end),
        Slopes(M, N, v_g, p_g, sum_of(p_g, s_g), difference_of(s_a, N), s_scale, s_mounting),
    )
