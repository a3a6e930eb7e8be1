"""The script of the gate: batches become references and are judged."""

import json

import regression_gate

from tests.recorded_batches import written_batch


def run(*words: object) -> int:
    return regression_gate.main([str(word) for word in words])


def test_a_batch_passes_by_its_own_reference(tmp_path, capsys):
    reference = tmp_path / "reference.json"
    folder = written_batch(tmp_path / "batch")
    assert run("bless", folder, reference) == 0
    assert (
        json.loads(reference.read_text("utf-8"))["format"]
        == "sonar_graph batch reference 2"
    )
    assert run("judge", folder, reference) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"Reference: {reference} (16 runs, 0 of which did not end)",
        "Hardly different from the reference: dead-reckoning, isam2",
        f"Gate: passed, 16 runs held against {reference}",
    ]
    assert run("judge", written_batch(tmp_path / "worse", 1.5), reference) == 1
    said = capsys.readouterr().out
    assert (
        "Worse: basin, isam2, causal.ate_se2_m: +50.0% in the mean of 8 cases, p = 0.0039 (of the whole batch)"
        in said
    )
    assert "Gate: failed" in said
    assert (
        "Would have been found in four of five batches: one error larger on all logs by about"
        in said
    )
    assert "Hardly different from the reference: dead-reckoning" in said
