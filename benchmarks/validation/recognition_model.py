"""Measure a model of recognition as the one that ships was, and compare both in basins that were left out.

    python benchmarks/validation/recognition_model.py -o MODEL.json

Basins of one lap in 200 s, 3 frames a second, two unknown objects beside each landmark, and conditions that follow from
the seed alone (`conditions_of`). Seeds 3001 to 3040 and 3210 to 3218 have all conditions at random, 3121 to 3123 long
windows (1.5 frames a second), 3201 to 3209 one or two conditions each. Seeds 3300 to 3315 have all at random and
landmarks of other designs, most without a plate (``bare_landmarks.toml``, ``mixed_landmarks.toml``): weights are of all
designs, the confusion matrix and the accuracy of ours. Seeds 1002 and 1004 are the basin as it is, three laps in 390 s,
5 frames a second. The model that ships is of every second basin (``--every 2``). Foam is 6 to 18 mm high, where the
designs say 12. The accuracy and the interval of reports are of the basins where it is 9 to 15 mm: another height is a
bias, for `sonar-graph calibrate` to measure. The height that ships is 0: true landmarks are the faces that sound sees.
The power of the bound that ships is 1, as of white noise: nearly all of these basins have short windows, of which a
fitted power would have to be carried on to bounds three times as large.
The fit is that of `calibrate`, about the model that ships; errors are those against the true pose of the sonar.

* `named`: share of the tracks of landmarks that end with a posterior of one half or more for the right one;
* `accepted`: the same for any landmark, of the tracks of other things;

each of every fifth basin, by weights fitted to the others, and by those that ship. `nats` is what a track's errors of
range and azimuth are less probable, by minus log p, where sigmas do not grow with the bound of the fit (power 0), or as
for white noise (power 1, that which ships), instead of with the fitted power. It passes when at most 1 in 20 other
things is accepted.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import conclude, in_parallel, make_parser, print_table

from sonar_graph.devices import DEFAULT_DESIGNS, LandmarkDesign, load_designs
from sonar_graph.recognition.confusion_fit import (
    LabelledFits,
    LabelledSightings,
    TrueObjects,
    accuracy,
    confusion_rows,
    estimate_confusion,
    fit_weights,
    track_sums,
    trials_of,
    without_height,
)
from sonar_graph.recognition.session import RecognitionSession, one_by_one
from sonar_graph.simulation import BasinOptions, simulate_basin, simulate_basin_frames
from sonar_graph.simulation.sonar_image import ImageOptions
from sonar_graph.sonar import (
    SHIPPED,
    IdentityParams,
    Recogniser,
    read_confusion,
    soft_scores,
)
from sonar_graph.sonar.bayes import bounded_evidence

RANDOM, WINDOWS_M, MILD = (
    (*range(3001, 3041), *range(3210, 3219)),
    {3121: 8.0, 3122: 9.5, 3123: 5.0},
    range(3201, 3210),
)
OTHERS = {
    seed: ("bare_landmarks.toml", "mixed_landmarks.toml")[seed // 2 % 2]
    for seed in range(3300, 3316)
}
"""Basins of other designs, which share the weights of the evidence."""
ACCURACY = (1002, 1004)
FOAM_M, SAME_HEIGHT_M = 0.012, 0.003
IDS = tuple(design.id for design in DEFAULT_DESIGNS)
FOLDS, ACCEPTED, MOST_ACCEPTED = 5, 0.5, 0.05
ACCURATE = (
    "range_sigma_m",
    "across_sigma_m",
    "range_bound_m",
    "across_bound_m",
    "bound_power",
    "report_interval_s",
    "height_bias_m",
)


def conditions_of(seed: int) -> dict[str, Any]:
    """Conditions of the scene of a seed, strangers apart."""
    rng = np.random.default_rng([seed, 20])
    drawn = {
        "contrast_db": rng.uniform(-6.5, 1.0),
        "plate_db": rng.choice([-8.0, rng.uniform(-8.0, 0.0), 0.0]),
        "foam_height_m": rng.uniform(0.006, 0.018),
        "sediment": rng.choice([0.0, rng.uniform(0.0, 0.3)]),
        "fouling": rng.choice([0.0, rng.uniform(0.0, 0.3)]),
        "texture_shape": np.exp(rng.uniform(np.log(1.2), np.log(8.0))),
        "ripple_height_m": rng.choice([0.0, rng.uniform(0.0, 0.012)]),
        "noise_db": rng.uniform(12.0, 24.0),
        "attitude_error_deg": rng.uniform(0.0, 0.7),
        "altitude_error_m": rng.uniform(0.0, 0.02),
    }
    if seed in RANDOM or seed in OTHERS:
        return {name: float(value) for name, value in drawn.items()}
    if seed in WINDOWS_M:
        return {"window_m": WINDOWS_M[seed], "contrast_db": float(drawn["contrast_db"])}
    few = ("contrast_db", "plate_db", "foam_height_m", "sediment", "fouling")
    return (
        {few[k]: float(drawn[few[k]]) for k in {seed % 5, seed // 2 % 5}}
        if seed in MILD
        else {}
    )


def is_as_designed(conditions: dict[str, Any]) -> bool:
    """Tell whether the foam is as high as its design says, to `SAME_HEIGHT_M`."""
    return abs(conditions.get("foam_height_m", FOAM_M) - FOAM_M) <= SAME_HEIGHT_M


def designs_of(seed: int) -> tuple[LandmarkDesign, ...]:
    """Designs of the landmarks in the basin of a seed."""
    return (
        load_designs(Path(__file__).with_name(OTHERS[seed]))
        if seed in OTHERS
        else DEFAULT_DESIGNS
    )


def sightings_of(seed: int) -> LabelledSightings:
    """What the recogniser sees in the basin of a seed, labelled by the truth."""
    known = conditions_of(seed)
    if known:
        rate_hz = 1.5 if "window_m" in known else 3.0
        if seed in OTHERS:
            known["designs"] = str(Path(__file__).with_name(OTHERS[seed]))
        image = ImageOptions.model_validate(
            {"strangers": ["natural", "look-alikes"]} | known
        )
        options = BasinOptions(
            duration_s=200.0, laps=1, seed=seed, frame_rate_hz=rate_hz, image=image
        )
    else:
        options = BasinOptions(
            duration_s=390.0, seed=seed, frame_rate_hz=5.0, image=ImageOptions()
        )
    sequence, found = simulate_basin(options), LabelledSightings(IDS)
    recogniser = Recogniser(sequence.calibration, designs_of(seed))
    session = RecognitionSession(sequence, recogniser)
    for block in simulate_basin_frames(options):
        truth, is_landmark = block.truth, block.truth.ids > 0
        columns = truth.range_m()[:, is_landmark], truth.azimuth_rad()[:, is_landmark]
        for frame, *range_azimuth in zip(
            one_by_one(block.frames), *columns, strict=True
        ):
            objects = TrueObjects(truth.ids[is_landmark], *range_azimuth)
            result = session.take(frame)
            for track in result.tracks:
                found.add(result.stamp_ns, seed, track, objects)
    return found


@dataclass
class Tally:
    """Tracks of landmarks and of other things, and how many were named rightly, or accepted."""

    landmarks: int = 0
    named: int = 0
    others: int = 0
    accepted: int = 0

    def count(
        self, found: LabelledSightings, weights: np.ndarray, looks: float, doubt: float
    ) -> None:
        """Add the ends of all tracks."""
        sums, counted, label, _ = track_sums(found.fits())
        odds = np.pad(sums @ weights, ((0, 0), (0, 1)))
        belief = bounded_evidence(
            IdentityParams().birth(len(IDS)), odds, counted, looks, doubt
        )
        best, is_known = np.argmax(belief, axis=1), label < len(IDS)
        is_accepted = (best < len(IDS)) & (belief.max(axis=1) >= ACCEPTED)
        self.landmarks += int(is_known.sum())
        self.named += int((is_accepted & (best == label)).sum())
        self.others += int((~is_known).sum())
        self.accepted += int((is_accepted & ~is_known).sum())


def together(parts: list[LabelledSightings]) -> LabelledSightings:
    """All sightings of several basins."""
    found = LabelledSightings(IDS)
    for part in parts:
        found.extend(part)
    return found


def nats_lost(fits: LabelledFits, fitted: float) -> dict[str, float]:
    """How much less probable a track's errors are by the powers 0 and 1 of the bound than by the fitted one."""
    _, error = without_height(fits)
    once = 1.0 / np.bincount(fits.track)[fits.track]

    def loss(power: float) -> float:
        usual, sigmas, _ = accuracy(
            error, fits.bound_m, fits.track, powers=(power, power)
        )
        variances = (sigmas * (fits.bound_m / usual) ** power) ** 2
        terms = 0.5 * (np.log(variances) + error**2 / variances).sum(axis=1)
        known = np.isfinite(terms)
        return float(np.average(terms[known], weights=once[known]))

    return {
        name: loss(power) - loss(fitted)
        for name, power in (("power 0", 0.0), ("power 1", 1.0))
    }


def main() -> None:
    parser = make_parser(__doc__, workers=True)
    parser.add_argument(
        "-o", "--output", type=Path, metavar="MODEL.json", help="write the model"
    )
    parser.add_argument(
        "--every", type=int, default=1, metavar="N", help="only one in N of the basins"
    )
    arguments = parser.parse_args()
    chosen = [*RANDOM, *WINDOWS_M, *MILD, *OTHERS][
        :: 30 if arguments.quick else arguments.every
    ]
    parts = in_parallel(sightings_of, chosen, arguments.workers, "basin")
    shipped = read_confusion(SHIPPED)
    anew, as_shipped = Tally(), Tally()
    for fold in range(FOLDS):
        weights, looks = fit_weights(
            together(
                [part for k, part in enumerate(parts) if k % FOLDS != fold]
            ).fits(),
            np.array(shipped.weights),
            shipped.looks,
        )
        if left_out := parts[fold::FOLDS]:
            anew.count(together(left_out), weights, looks, shipped.doubt)
            as_shipped.count(
                together(left_out),
                np.array(shipped.weights),
                shipped.looks,
                shipped.doubt,
            )
    provenance = {
        "origin": f"simulated basins of benchmarks/validation/{Path(__file__).name}",
        "basins": ", ".join(map(str, chosen)),
    }
    ours = {
        seed: part
        for seed, part in zip(chosen, parts, strict=True)
        if seed not in OTHERS
    }
    fits = together([*ours.values()]).fits()
    model = estimate_confusion(fits, IDS, provenance, DEFAULT_DESIGNS)
    weights, looks = fit_weights(
        together(parts).fits(), np.array(shipped.weights), shipped.looks
    )
    scores = soft_scores(np.pad(fits.evidence @ weights, ((0, 0), (0, 1))), looks)
    matrix = tuple(
        map(tuple, confusion_rows(scores, fits.label, trials_of(fits)).tolist())
    )
    # never seen in n tracks: one in 2 n
    doubt = 0.5 / len(np.unique(together(parts).fits().track))
    model = model.model_copy(
        update={
            "weights": tuple(weights.tolist()),
            "looks": looks,
            "matrix": matrix,
            "doubt": doubt,
        }
    )
    plain = in_parallel(
        sightings_of,
        [] if arguments.quick else list(ACCURACY),
        arguments.workers,
        "accuracy",
    )
    near = [
        part for seed, part in ours.items() if is_as_designed(conditions_of(seed))
    ] + plain
    fits_near = together(near).fits()
    of_near = estimate_confusion(fits_near, IDS, {}, DEFAULT_DESIGNS)
    usual, sigmas, _ = accuracy(
        without_height(fits_near)[1],
        fits_near.bound_m,
        fits_near.track,
        powers=(1.0, 1.0),
    )
    of_accuracy = *sigmas.tolist(), *usual.tolist(), 1.0, of_near.report_interval_s, 0.0
    accurate = dict(zip(ACCURATE, of_accuracy, strict=True))
    model = model.model_copy(update=accurate)
    if arguments.output is not None:
        arguments.output.write_text(
            model.model_dump_json(indent=2) + "\n", encoding="utf-8"
        )
    print_table(
        ("", "landmarks", "named", "others", "accepted"),
        [
            (name, *vars(tally).values())
            for name, tally in (("anew", anew), ("as shipped", as_shipped))
        ],
    )
    values = [
        ("looks", model.looks, shipped.looks),
        *((n, getattr(model, n), getattr(shipped, n)) for n in accurate),
    ]
    values += [
        (f"weight {k}", *pair)
        for k, pair in enumerate(zip(model.weights, shipped.weights, strict=True))
    ]
    print_table(
        ("", "anew", "shipped"),
        [(name, *(f"{value:.5g}" for value in pair)) for name, *pair in values],
    )
    lost = nats_lost(fits_near, of_near.bound_power)
    print_table(
        ("sigma grows with the bound", "nats"),
        [(name, f"{nats:.2f}") for name, nats in lost.items()],
    )
    figures = {
        "basins": len(parts),
        "fitted_power": of_near.bound_power,
        "nats_lost": lost,
        "anew": vars(anew),
        "as_shipped": vars(as_shipped),
    }
    conclude(
        figures | {"passed": anew.accepted <= MOST_ACCEPTED * anew.others},
        is_quick=arguments.quick,
    )


if __name__ == "__main__":
    main()
