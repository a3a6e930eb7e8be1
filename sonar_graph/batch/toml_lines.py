"""On which line of a TOML file a key stands: `tomllib` gives values without places."""

from __future__ import annotations

import re

Place = tuple[int | str, ...]

_NAME = r"""(?:[A-Za-z0-9_-]+|"[^"]*"|'[^']*')"""
_DOTTED = rf"{_NAME}(?:\s*\.\s*{_NAME})*"
_HEADER = re.compile(rf"\s*(?P<array>\[)?\[\s*(?P<path>{_DOTTED})\s*\]")
_KEY = re.compile(rf"\s*(?P<path>{_DOTTED})\s*=")
_TEXT_MARKS = ('"""', "'''")


def line_of(text: str, place: Place) -> int:
    """The line, counted from 1, of a key, or of the nearest thing around it that has a line of its own.

    Parameters
    ----------
    text
        A valid TOML document.
    place
        Names of tables and keys, and numbers, from 0, of the entries of arrays.
    """
    lines = _lines_of_keys(text)
    return next(lines[place[:length]] for length in range(len(place), -1, -1) if place[:length] in lines)


def _lines_of_keys(text: str) -> dict[Place, int]:
    lines: dict[Place, int] = {(): 1}
    entries: dict[Place, int] = {}
    table: Place = ()
    for number, line in _lines_outside_texts(text):
        if header := _HEADER.match(line):
            table = _table(_names(header["path"]), header["array"] is not None, entries)
            lines.setdefault(table, number)
            if header["array"]:
                lines.setdefault(table[:-1], number)
        elif key := _KEY.match(line):
            names = _names(key["path"])
            for length in range(1, len(names) + 1):
                lines.setdefault((*table, *names[:length]), number)
    return lines


def _table(names: list[str], is_array: bool, entries: dict[Place, int]) -> Place:
    """The place of a header's table; names of arrays are followed by the number of their last entry."""
    place: Place = ()
    for depth, name in enumerate(names, start=1):
        place = (*place, name)
        if is_array and depth == len(names):
            entries[place] = entries.get(place, -1) + 1
        if place in entries:
            place = (*place, entries[place])
    return place


def _lines_outside_texts(text: str) -> list[tuple[int, str]]:
    """Numbered lines, without those inside of texts of several lines."""
    outside, open_mark = [], ""
    for number, line in enumerate(text.splitlines(), start=1):
        if not open_mark:
            outside.append((number, line))
        for mark in _TEXT_MARKS:
            if open_mark in ("", mark) and line.count(mark) % 2:
                open_mark = "" if open_mark else mark
    return outside


def _names(path: str) -> list[str]:
    return [name.strip("\"'") for name in re.findall(_NAME, path)]
