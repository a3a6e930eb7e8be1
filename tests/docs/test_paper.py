"""The paper has the sections that JOSS asks for, and cites what its bibliography has."""

import re
from pathlib import Path

PAPER = Path(__file__).parents[2] / "docs" / "paper"


def test_the_paper_has_the_sections_that_joss_asks_for_in_at_most_1750_words():
    text = (PAPER / "paper.md").read_text("utf-8")
    sections = re.findall(r"^# (.*)$", text, re.MULTILINE)
    for wanted in (
        "Summary",
        "Statement of need",
        "State of the field",
        "Software design",
        "AI usage disclosure",
    ):
        assert wanted in sections
    assert 750 <= len(text.split("---")[2].split()) <= 1750


def test_all_that_is_cited_is_in_the_bibliography_and_the_reverse():
    cited = set(re.findall(r"@([A-Za-z]+\d*)", (PAPER / "paper.md").read_text("utf-8")))
    assert cited == set(
        re.findall(
            r"^@\w+\{(\w+),", (PAPER / "paper.bib").read_text("utf-8"), re.MULTILINE
        )
    )
