"""Metadata records that carry their own checksum, because the container gives them none."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping

from sonar_graph.errors import LogError

_SEAL = "crc32"


def seal(metadata: Mapping[str, str]) -> dict[str, str]:
    """The metadata with a CRC-32 over its keys and values, under the key ``crc32``."""
    return {**metadata, _SEAL: _checksum(metadata)}


def open_seal(metadata: Mapping[str, str]) -> tuple[dict[str, str], bool]:
    """The metadata without the checksum, and whether it had one.

    Raises
    ------
    LogError
        When the checksum does not fit.
    """
    content = {key: value for key, value in metadata.items() if key != _SEAL}
    if _SEAL not in metadata:
        return content, False
    if metadata[_SEAL] != _checksum(content):
        raise LogError("its CRC does not fit its content")
    return content, True


def _checksum(metadata: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(sorted(metadata.items())).encode()):08x}"
