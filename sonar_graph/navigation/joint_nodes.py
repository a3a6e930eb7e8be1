"""What a Doppler sample does to the joint integral.

Rule "inertial". With the velocity v(t) that the accelerometer gives from rest and the velocity z of the IMU's point,
``y_k = R_k z_k - v_k`` would be the same at every sample k but for gravity, which makes it linear in time. Its
trapezoid is therefore exact, and ::

    s = p + sum_k w_k y_k,     w_k half of the two intervals at sample k

is a displacement in which the accelerometer draws the velocity between samples and the samples its level and slope:
gravity, the initial velocity and an accelerometer bias that is constant in frame i all cancel, however long the gap.
A Doppler log at another place swings about the IMU's point: over short intervals that is left to the trapezoid, over
long ones it is drawn by the gyros (`sonar_graph.navigation.long_intervals`).

All other rules. ``s = sum_k W_k z_k``, W_k from the rotations around sample k.

Either way sample k enters by one weight matrix W_k, ``cov(ds) += W_k Q_k W_k^T``. Those of the first and last sample
are kept apart: the neighbouring motion has the same sample.
"""

from __future__ import annotations

from sonar_graph.navigation.joint_state import Path, Slopes, Spread
from sonar_graph.navigation.kernels import inlined
from sonar_graph.navigation.triples import (
    Matrix,
    Vector,
    difference_of,
    minus,
    multiple_of,
    plus,
    scaled,
    skew_times,
    sum_of,
    times,
    times_skew,
    transposed,
)


@inlined
def with_sample(
    path: Path, spread: Spread, slopes: Slopes, z: Vector, weight_s: float, gyro_psd: float
) -> tuple[Path, Spread, Slopes]:
    """After ``w_k y_k`` is added; the sample's own noise is not in the spread.

    With ``e = -w ([R z]x theta + dv)`` the error that is added.
    """
    w, turned = weight_s, times(path.R, z)
    variance = gyro_psd * path.elapsed_s
    by_v = _skew_product(turned, spread.mv)
    e_v = multiple_of(-w, sum_of(by_v, spread.vv))
    e_p = multiple_of(-w, sum_of(_skew_product(turned, spread.mp), spread.vp))
    e_s = multiple_of(-w, sum_of(_skew_product(turned, spread.ms), transposed(spread.sv)))
    e_e = difference_of(sum_of(by_v, transposed(by_v)), multiple_of(variance, _skew_product(turned, turned)))
    e_e = multiple_of(w * w, sum_of(e_e, spread.vv))
    y = minus(turned, path.v)
    after = Path(path.elapsed_s, path.R, path.v, path.p, plus(path.s, scaled(w, y)))
    e_m = scaled(w, minus(scaled(variance, turned), spread.mv))
    ss = sum_of(sum_of(spread.ss, e_e), sum_of(e_s, transposed(e_s)))
    return (
        after,
        Spread(
            spread.mv,
            spread.mp,
            plus(spread.ms, e_m),
            spread.vv,
            spread.vp,
            spread.pp,
            sum_of(spread.sv, e_v),
            sum_of(spread.sp, e_p),
            ss,
        ),
        Slopes(
            slopes.M,
            slopes.N,
            slopes.v_g,
            slopes.p_g,
            sum_of(slopes.s_g, multiple_of(w, difference_of(skew_times(turned, slopes.M), slopes.v_g))),
            sum_of(slopes.s_a, multiple_of(w, slopes.M)),
            plus(slopes.s_scale, scaled(w, turned)),
            difference_of(slopes.s_mounting, multiple_of(w, times_skew(path.R, z))),
        ),
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
    """At the end, ``s <- p + s``."""
    sp = sum_of(spread.pp, spread.sp)
    return (
        Path(path.elapsed_s, path.R, path.v, path.p, plus(path.p, path.s)),
        Spread(
            spread.mv,
            spread.mp,
            plus(spread.mp, spread.ms),
            spread.vv,
            spread.vp,
            spread.pp,
            sum_of(transposed(spread.vp), spread.sv),
            sp,
            sum_of(sum_of(spread.ss, transposed(spread.sp)), sp),
        ),
        Slopes(
            slopes.M,
            slopes.N,
            slopes.v_g,
            slopes.p_g,
            sum_of(slopes.p_g, slopes.s_g),
            difference_of(slopes.s_a, slopes.N),
            slopes.s_scale,
            slopes.s_mounting,
        ),
    )
