"""Many runs of one experiment: gathered by seed, told in sentences, drawn, and read again."""

from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.evaluation.comparison import compare
from sonar_graph.evaluation.ensemble import KEPT, run_ensembles, run_member
from sonar_graph.evaluation.results import Ensemble
from sonar_graph.evaluation.storage import read_comparison, write_comparison
from sonar_graph.report.comparison_page import render_report
from sonar_graph.report.console import summary
from sonar_graph.report.ensemble_section import (
    anees_at_end,
    ensemble_figure,
    ensemble_sentences,
    ensemble_table,
)
from sonar_graph.simulation import BasinOptions

from .conftest import straight_sequence

HEADLINE = KEPT[0]


def made(
    condition: str = "by hand", scale: float = 1.0, **errors_m: list[float | None]
) -> Ensemble:
    """Runs with these errors, whose NEES is chi-square times the scale."""
    rng, runs = np.random.default_rng(0), len(next(iter(errors_m.values())))

    def series(dof: int, errors: list[float | None]) -> list:
        drawn = scale * rng.chisquare(dof, (runs, 5)) / dof
        drawn[:, :-1] *= 100.0  # only the last instant counts
        runs_of = zip(errors, drawn.tolist(), strict=True)
        return [
            None if error is None else [float("nan"), *one] for error, one in runs_of
        ]

    return Ensemble(
        condition,
        list(range(runs)),
        [float(k) for k in range(6)],
        {
            name: {key: list(errors) for key in KEPT}
            for name, errors in errors_m.items()
        },
        {name: series(2, errors) for name, errors in errors_m.items()},
        {
            name: {"position": series(3, errors), "yaw": series(1, errors)}
            for name, errors in errors_m.items()
        },
    )


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
    assert found.seeds == [1, 2]
    assert (
        found.values["dead-reckoning"][HEADLINE][1]
        == alone.values["dead-reckoning"][HEADLINE]
    )
    assert (
        found.values["dead-reckoning"][HEADLINE][0]
        != found.values["dead-reckoning"][HEADLINE][1]
    )
    assert found.errors_m["dead-reckoning"][1] == alone.errors_m["dead-reckoning"]
    assert len(found.seconds) == len(found.errors_m["dead-reckoning"][0])
    assert [done for _, done, _ in calls] == [1, 2]


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
def test_consistency_of_the_runs_is_judged_at_their_last_scored_instant(scale, verdict):
    assert (
        anees_at_end(made(scale=scale, good=GOOD), "good", "position", 3).verdict
        == verdict
    )
    lost = made(scale=scale, good=[None, *GOOD[1:]])
    assert anees_at_end(lost, "good", "position", 3).verdict == ""
    rows = ensemble_table(made(scale=scale, good=GOOD), "x").rows
    assert rows[0][-2].note.startswith(verdict)
    assert rows[0][1].text.startswith("0.11")


def test_a_figure_shows_every_estimator_that_came_to_an_end_and_none_where_nobody_did():
    figure = ensemble_figure(made(good=GOOD, bad=[None] * 20))
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["good"]
    assert ensemble_figure(made(bad=[None] * 3)) is None


def test_runs_are_kept_in_the_folder_and_stand_first_on_the_page_and_in_the_terminal(
    install, tmp_path
):
    comparison = replace(
        compare(straight_sequence(), ["offset"]),
        ensembles=[made(good=GOOD, bad=[None, *BAD[1:]])],
    )
    write_comparison(comparison, tmp_path)
    again = read_comparison(tmp_path)
    assert again.ensembles[0].values == comparison.ensembles[0].values
    assert again.ensembles[0].nees["good"]["yaw"][0][0] is None, (
        "what is not a number is null"
    )
    page = render_report(again)
    assert (
        page.index('id="figure-map"')
        < page.index("One run is one sample")
        < page.index("20 runs by hand")
        < page.index("The basin is simulated")
    )
    assert 'id="figure-runs-1"' in page
    assert "20 runs by hand" in str(summary(again).renderables[-1])
    write_comparison(replace(comparison, ensembles=[]), tmp_path)
    assert read_comparison(tmp_path).ensembles == []
    assert "Many runs" not in render_report(read_comparison(tmp_path))
