"""What the values in text tables prove: the units of times, and which mark a valid row has."""

import re
from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from sonar_graph.logs.adapters import LAST_S, TIMES
from sonar_graph.logs.convert.csv_table import CsvFile
from sonar_graph.measurements import Floats

UNITS = ("s", "ms", "us", "ns")
RATES_HZ = {"imu": (0.5, 5000.0), "dvl": (0.05, 200.0)}
"""Slowest and fastest rate of a sensor, by role."""
FASTEST_HZ = 1e4
"""Fastest rate of any other table."""
FEWEST_ROWS = 10
"""Rows from which a rate, and a column that never changes, are known."""
_SIMILAR = 30.0
"""Ratio of two spans up to which tables are of one dive; units differ by a factor of 1000, more than its square."""
VALIDITY = ("valid", "lock", "flag", "status", "good")
"""Words in the names of columns that may mark valid rows, the likeliest first."""
_DATES_S = (6.3e8, 4.1e9)
"""Seconds since 1970 of the years 1990 and 2100."""


def time_units(
    times: Mapping[str, Floats],
    roles: Mapping[str, str],
    known: Mapping[str, str],
) -> dict[str, list[str]]:
    """Units in which all tables together are plausible, by table.

    The IMU leads: its rate and that of the Doppler log have to be possible, and the other tables have to overlap it, or
    to last about as long.

    Parameters
    ----------
    times
        Times as written, ascending and each once, by table.
    roles
        Role of each table; one of them is that of an IMU.
    known
        Units that are stated, by table.

    Returns
    -------
    dict
        Units by table, without tables of too few rows: one where it is sure, none where no unit fits.
    """
    lead = next((table for table, role in roles.items() if role == "imu"), None)
    if lead is None or len(times[lead]) < FEWEST_ROWS:
        return {}
    # units in which each table by itself is plausible
    fits = {
        table: [known[table]]
        if table in known
        else [
            unit
            for unit in UNITS
            if values[-1] * TIMES[unit] < LAST_S
            and (
                # columns of one merged table share the rate of its fastest sensor
                (table != lead and len(values) == len(times[lead]))
                or _has_rate_of(roles[table], values * TIMES[unit])
            )
        ]
        for table, values in times.items()
        if len(values) > 1
    }
    # then together: what a unit of the IMU leaves for the others
    possible: dict[str, dict[str, list[str]]] = {}
    for unit in fits[lead]:
        lead_s = times[lead] * TIMES[unit]
        possible[unit] = {
            table: _of_one_dive(times[table], units, lead_s, roles[table])
            for table, units in fits.items()
        } | {lead: [unit]}
    # a Doppler log that fits no unit must not decide about the IMU
    dvls = [table for table in fits if roles[table] == "dvl"]
    complete = [unit for unit in possible if all(possible[unit][dvl] for dvl in dvls)]
    # an IMU of 1 Hz in seconds looks like one of 1 kHz in milliseconds: a date shows which
    last = times[lead][-1]
    dated = [u for u in complete if _DATES_S[0] < last * TIMES[u] < _DATES_S[1]]
    chosen = dated or complete or list(possible)
    return {
        table: [u for u in UNITS if any(u in possible[unit][table] for unit in chosen)]
        for table in fits
    }


def _has_rate_of(role: str, times_s: Floats) -> bool:
    """True where a sensor can have the median rate of its times, or too few are known."""
    slowest_hz, fastest_hz = RATES_HZ.get(role, (0.0, FASTEST_HZ))
    if len(times_s) < FEWEST_ROWS:
        return True
    # the median: pauses of a sensor do not count
    return slowest_hz <= 1 / float(np.median(np.diff(times_s))) <= fastest_hz


def _of_one_dive(
    times: Floats, units: list[str], lead_s: Floats, role: str
) -> list[str]:
    """Units in which times belong to the dive of the IMU: by overlap and duration, else by one of them."""
    overlapping = {
        unit
        for unit in units
        if times[0] * TIMES[unit] <= lead_s[-1] and times[-1] * TIMES[unit] >= lead_s[0]
    }
    as_long = {
        unit
        for unit in units
        if 1 / _SIMILAR < np.ptp(times) * TIMES[unit] / np.ptp(lead_s) < _SIMILAR
    }
    chosen = overlapping & as_long or overlapping or as_long
    if role == "dvl":
        # a logger of depths may run all day, a sonar for a minute; a Doppler log runs as long as the IMU
        chosen &= as_long
    return [unit for unit in units if unit in chosen]


def marked_valid(
    file: CsvFile, names: Iterable[str], velocity: Floats
) -> Iterator[tuple[str, int, Floats]]:
    """Columns, among some, that mark valid rows, with the mark, 0 or 1, and the values; the likeliest name first.

    The mark is known by the velocities of all rows, ``velocity`` of shape (n, 3), else by the name.
    """
    absent = is_absent(velocity)
    likely = [n for word in VALIDITY for n in names if word in n.lower()]
    # a name may hold two of the words
    for name in dict.fromkeys(likely):
        (marks,) = file.numbers(name)
        # counts of beams and codes of errors have more than two values
        if not np.isin(marks, (0.0, 1.0)).all():
            continue
        for mark in (1, 0):
            lost = absent[marks != mark]
            if len(lost) and lost.all() and not absent[marks == mark].all():
                yield name, mark, marks
                break
        else:
            # the velocities prove nothing where a driver holds the last one
            if re.search(r"valid|lock|good", name.lower()) and not re.search(
                r"invalid|status|unlock", name.lower()
            ):
                yield name, 1, marks


def is_absent(vectors: Floats) -> NDArray[np.bool_]:
    """Rows of vectors, shape (n, m), that are not measured: empty, or one number such as -32768 in all components."""
    is_empty = np.asarray(~np.isfinite(vectors).all(axis=1))
    # one component may well be zero
    if vectors.shape[1] == 1:
        return is_empty
    return is_empty | (np.ptp(vectors, axis=1) == 0)
