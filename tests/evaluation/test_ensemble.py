"""Many runs of one experiment: gathered by seed, summed up in sentences and a table, and read again."""

from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.evaluation.comparison import compare
from sonar_graph.evaluation.ensemble import (
    KEPT,
    RATE_HZ,
    run_ensembles,
    run_member,
)
from sonar_graph.evaluation.results import Ensemble
from sonar_graph.evaluation.storage import read_comparison, write_comparison
from sonar_graph.report.comparison_page import render_report
from sonar_graph.report.console import summary
from sonar_graph.report.ensemble_section import ensemble_sentences, ensemble_table
from sonar_graph.simulation import BasinOptions, simulate_basin

from .conftest import straight_sequence

HEADLINE = KEPT[0]


def made(
    condition: str = "by hand", scale: float = 1.0, **errors_m: list[float | None]
) -> Ensemble:
    """Runs with these errors, whose NEES is chi-square times the scale."""
    rng = np.random.default_rng(0)

    def nees_of(dof: int, errors: list[float | None]) -> list[float | None]:
        drawn = (scale * rng.chisquare(dof, len(errors)) / dof).tolist()
        runs = zip(errors, drawn, strict=True)
        return [None if error is None else nees for error, nees in runs]

    values = {}
    for name, errors in errors_m.items():
        values[name] = {key: list(errors) for key in KEPT}
        values[name]["causal.nees_position_end"] = nees_of(3, errors)
        values[name]["causal.nees_yaw_end"] = nees_of(1, errors)
    seeds = list(range(len(next(iter(errors_m.values())))))
    return Ensemble(condition, seeds, values)


GOOD, BAD = (
    [0.1 + 0.001 * k for k in range(20)],
    [0.105 + 0.02 * (k % 4) - 0.02 * (k == 3) for k in range(20)],
)


def test_a_run_of_an_ensemble_is_the_run_of_a_comparison_and_seeds_make_them_differ():
    options, names = (
        BasinOptions(duration_s=120.0, laps=1, imu="mti1"),
        ["dead-reckoning"],
    )
    calls = []
    (found,) = run_ensembles(
        {"x": options},
        range(1, 3),
        names,
        workers=1,
        progress=lambda *call: calls.append(call),
    )
    alone = run_member(options.model_copy(update={"seed": 2}), names)
    first, second = found.values["dead-reckoning"][HEADLINE]
    assert found.seeds == [1, 2]
    assert second == alone["dead-reckoning"][HEADLINE]
    assert first != second
    assert found.nees_at_end("dead-reckoning", "yaw").shape == (2,)
    assert [done for _, done, _ in calls] == [1, 2]


def test_nees_at_the_end_is_that_of_the_last_scored_instant():
    options = BasinOptions(duration_s=120.0, laps=1)
    alone = run_member(options, ["dead-reckoning"])["dead-reckoning"]
    sequence = simulate_basin(options)
    errors = compare(sequence, ["dead-reckoning"], rate_hz=RATE_HZ).errors[
        "dead-reckoning"
    ]["causal"]
    assert alone["causal.nees_position_end"] == errors.nees_position[-1] / 3
    assert alone["causal.nees_yaw_end"] == errors.nees_yaw[-1]


def test_sentences_tell_means_with_intervals_how_often_the_order_turns_and_both_conditions():
    one, other = ensemble_sentences(
        [made("as hard", good=GOOD, bad=BAD), made("as easy", good=GOOD, bad=GOOD)]
    )
    wins = int((np.array(GOOD) < BAD).sum())
    assert one.startswith(
        "20 runs as hard: mean position error (causal: told at once, from what was measured until then;"
    )
    assert one.index("good 0.11") < one.index("bad 0.1")
    assert (
        f"good has the smaller error in {wins} of them, bad in {20 - wins}: one run could have said either"
        in one
    )
    assert other.startswith(
        "Under other conditions it may be otherwise: 20 runs as easy: mean causal pos"
    )
    (sure,) = ensemble_sentences([made(good=GOOD, bad=[2 * error for error in GOOD])])
    assert "either" not in sure
    assert sure.endswith("good has the smaller error in every one of them.")
    for filter_, said in ((BAD, True), ([0.5 * error for error in GOOD], False)):
        (odd,) = ensemble_sentences(
            [made(**{"dead-reckoning": GOOD, "ekf-slam": filter_})]
        )
        assert (
            "ekf-slam is worse than dead-reckoning, which only adds up motion. That can be: as pub"
            in odd
        ) == said
    (lost,) = ensemble_sentences([made(good=GOOD, bad=[None, *GOOD[1:]])])
    assert "bad 1 of 20 runs without" in lost
    assert ensemble_sentences([]) == []


@pytest.mark.parametrize(
    ("scale", "verdict"), [(1.0, "consistent"), (4.0, "over-confident")]
)
def test_consistency_of_the_runs_is_judged_by_their_anees_at_the_end(scale, verdict):
    table = ensemble_table(made(scale=scale, good=GOOD, bad=[None, *BAD[1:]]), "x")
    good, bad = table.rows
    assert good[-2].note.startswith(verdict)
    assert good[1].text.startswith("0.11")
    assert bad[-2].note == "", "a run that was lost leaves no verdict"


def test_runs_are_kept_in_the_folder_and_stand_first_on_the_page_and_in_the_terminal(
    install, tmp_path
):
    comparison = replace(
        compare(straight_sequence(), ["offset"]),
        ensembles=[made(good=GOOD, bad=[None, *BAD[1:]])],
    )
    write_comparison(comparison, tmp_path)
    again = read_comparison(tmp_path)
    assert again.ensembles == comparison.ensembles
    page = render_report(again)
    assert (
        page.index('id="figure-map"')
        < page.index("One run is one sample")
        < page.index("20 runs by hand")
        < page.index("The basin is simulated")
    )
    assert "20 runs by hand" in str(summary(again).renderables[-1])
    write_comparison(replace(comparison, ensembles=[]), tmp_path)
    assert read_comparison(tmp_path).ensembles == []
    assert "Many runs" not in render_report(read_comparison(tmp_path))
