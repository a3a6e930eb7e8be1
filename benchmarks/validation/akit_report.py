"""Tables and figures of `akit`, from what was measured on each trajectory."""

from typing import Any

import numpy as np
from akit_landmarks import ESTIMATORS, MEASURES, PLACINGS, UNSURE_START
from common import print_table
from scipy.stats import chi2

LARGEST_SHARE_OF_DISTANCE = 0.01
Figures = dict[str, Any]


def report(numbers: tuple[int, ...], runs: list[Figures]) -> Figures:
    """Print the tables; the figures by name."""
    print_trajectories(numbers, runs)
    print_gap_widths(runs)
    print_slam(numbers, runs)
    figures = alignment_figures(runs) | gap_figures(runs) | slam_figures(numbers, runs)
    held = (
        max(figures["aligned_shares"]) <= LARGEST_SHARE_OF_DISTANCE,
        figures["gap_share_inside"] == 1.0,
        figures["gap_share_inside_as_converted"] == 1.0,
        min(figures["landmarks_help"].values()) >= 1.0,
    )
    return {"trajectories": numbers} | figures | {"passed": all(held)}


def print_trajectories(numbers: tuple[int, ...], runs: list[Figures]) -> None:
    """Offsets and errors of each trajectory, and how many of its gaps the ellipse holds."""
    headers = (
        "",
        "DVL offset s",
        "reference offset s",
        "start heading deg",
        "converted %",
        "aligned %",
        "IMU at reference",
        "IMU as converted",
        "IMU by others",
    )
    gaps = (
        inside_ellipse(runs, gaps, "square")
        for gaps in ("gaps_unplaced", "gaps_as_converted", "gaps")
    )
    rows = [
        (
            f"trajectory {number}",
            r["dvl_offset"][0],
            r["reference_offset"][0],
            float(np.degrees(r["start_heading_rad"])),
            100 * r["as_converted"]["share"],
            100 * r["aligned"]["share"],
            *(f"{sum(held)} of {len(held)}" for held in of_run),
        )
        for number, r, *of_run in zip(numbers, runs, *gaps, strict=True)
    ]
    print_table(headers, rows)


def print_gap_widths(runs: list[Figures]) -> None:
    """Errors in gaps and their claimed sigmas, with and without a bias of the accelerometers."""
    print_table(
        ("IMU by others", "lost rms m", "sigma rms m", "least", "largest", "NEES"),
        [
            ("as calibrated", *gap_width(runs, "gaps")),
            ("no accel bias", *gap_width(runs, "gaps_unbiased")),
        ],
    )


def alignment_figures(runs: list[Figures]) -> Figures:
    """Dead reckoning of whole trajectories, and the offsets with which they are aligned."""
    return {
        "aligned_shares": [r["aligned"]["share"] for r in runs],
        "converted_shares": [r["as_converted"]["share"] for r in runs],
        "start_heading_rad": [r["start_heading_rad"] for r in runs],
        "dvl_offset_s": [r["dvl_offset"] for r in runs],
        "reference_offset_s": [r["reference_offset"] for r in runs],
    }


def gap_figures(runs: list[Figures]) -> Figures:
    """Errors in gaps, and the share inside the ellipse."""
    calibrated, unbiased = gap_width(runs, "gaps"), gap_width(runs, "gaps_unbiased")
    return {
        "gap_lost_m": lost_m(runs, "gaps"),
        "gap_sigma_m": [[gap["sigma_m"] for gap in r["gaps"]] for r in runs],
        "gap_share_inside": share_inside(runs, "gaps", "square"),
        "gap_nees_per_dof": calibrated[-1],
        "gap_unbiased_sigma_rms_m": unbiased[1],
        "gap_unbiased_nees_per_dof": unbiased[-1],
        "gap_share_inside_as_converted": share_inside(
            runs, "gaps_as_converted", "square"
        ),
        "gap_lost_as_converted_m": lost_m(runs, "gaps_as_converted"),
        "gap_share_inside_unplaced": share_inside(runs, "gaps_unplaced", "square"),
        "gap_lost_unplaced_m": lost_m(runs, "gaps_unplaced"),
        "gap_share_inside_literally": share_inside(runs, "gaps", "literal_square"),
        "share_inside_literally_without_gap": share_inside(
            runs, "gaps", "without_gap_square"
        ),
        "literal_squares": [
            [(gap["literal_square"], gap["without_gap_square"]) for gap in r["gaps"]]
            for r in runs
        ],
    }


def slam_figures(numbers: tuple[int, ...], runs: list[Figures]) -> Figures:
    """Gain by landmarks, and its least value against dead reckoning where the start is known."""
    sure = [r for n, r in zip(numbers, runs, strict=True) if n not in UNSURE_START]
    return {
        "reference_wander_m": [r["reference_wander_m"] for r in runs],
        "sightings": [r["sightings"] for r in runs],
        "slam": [
            {
                placing: {
                    name: {m: v if np.isfinite(v) else None for m, v in own.items()}
                    for name, own in each.items()
                }
                for placing, each in r["slam"].items()
            }
            for r in runs
        ],
        "landmarks_help": {
            f"{placing} {kind}": min(
                error_ratio(r["slam"][placing], kind) for r in sure
            )
            for placing in ("near", "far")
            for kind in ("causal", "smoothed")
        },
    }


def lost_m(runs: list[Figures], gaps: str) -> list[list[float]]:
    """In each gap."""
    return [[gap["lost_m"] for gap in r[gaps]] for r in runs]


def share_inside(runs: list[Figures], gaps: str, name: str) -> float:
    """Share of all gaps inside the 99 % ellipse."""
    return float(np.mean(inside_ellipse(runs, gaps, name)))


def inside_ellipse(runs: list[Figures], gaps: str, name: str) -> list[list[bool]]:
    """Mask of gaps whose squared error lies in the 99 % ellipse."""
    limit = float(chi2.ppf(0.99, 3))
    return [[gap[name] <= limit for gap in r[gaps]] for r in runs]


def gap_width(
    runs: list[Figures], gaps: str
) -> tuple[float, float, float, float, float]:
    """RMS of error and sigma, least and largest sigma, m, and the NEES per dimension."""
    lost, sigma, squares = (
        np.array([gap[of] for r in runs for gap in r[gaps]])
        for of in ("lost_m", "sigma_m", "square")
    )
    rms = (float(np.sqrt(np.mean(values**2))) for values in (lost, sigma))
    return (*rms, float(sigma.min()), float(sigma.max()), float(squares.mean()) / 3)


def print_slam(numbers: tuple[int, ...], runs: list[Figures]) -> None:
    """Causal and smoothed scores of all estimators in each placing."""
    print_table(
        (
            "",
            "reference wanders m/s",
            "at most m",
            *(f"{name}: times, s" for name in PLACINGS),
        ),
        [
            (
                f"trajectory {n}",
                *r["reference_wander_m"],
                *(f"{t:.0f}, {s:.0f}" for t, s in r["sightings"].values()),
            )
            for n, r in zip(numbers, runs, strict=True)
        ],
    )
    for placing in PLACINGS:
        rows = [
            (
                f"trajectory {n} {name} {kind}",
                *(r["slam"][placing][name][f"{kind}.{m}"] for m in MEASURES),
            )
            for n, r in zip(numbers, runs, strict=True)
            for name, kind in (
                ("isam2", "smoothed"),
                *((name, "causal") for name in ESTIMATORS),
            )
        ]
        print_table((placing, "raw m", "SE(2) m", "10 s m", "NEES", "yaw NEES"), rows)


def error_ratio(scores: dict[str, dict[str, float]], kind: str) -> float:
    """Dead reckoning's error after SE(2) alignment over iSAM2's."""
    return (
        scores["dead-reckoning"]["causal.ate_se2_m"]
        / scores["isam2"][f"{kind}.ate_se2_m"]
    )
