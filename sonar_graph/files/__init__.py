"""Files and processes: inputs, atomic writing, folders of results, Ctrl-C, and processes for others' code."""

# fmt: off
from sonar_graph.files.inputs import as_path, parsed_toml, read_json, read_toml, regular, spelt, strict_json, text_of
from sonar_graph.files.interrupts import (
    INTERRUPTED, deferred_interrupt, end_at_once, interrupt_event, loading, noticed_interrupts,
    terminations_as_interrupts,
)
from sonar_graph.files.own_process import READY, KilledError, OwnProcess, Tell, serve
from sonar_graph.files.result_folder import (
    BATCH, COMPARISON, LOCK, MANIFEST, PAPER, Manifest, digest_of, others_in, refused, remove_written, replacing,
    result_folder, result_written, write_json, written_whole,
)

__all__ = [
    "BATCH", "COMPARISON", "INTERRUPTED", "KilledError", "LOCK", "MANIFEST", "Manifest", "OwnProcess", "PAPER",
    "READY", "Tell", "as_path", "deferred_interrupt", "digest_of", "end_at_once", "interrupt_event", "loading",
    "noticed_interrupts", "others_in", "parsed_toml", "read_json", "read_toml", "refused", "regular", "remove_written",
    "replacing", "result_folder", "result_written", "serve", "spelt", "strict_json", "terminations_as_interrupts",
    "text_of", "write_json", "written_whole",
]
