"""Atomic writing, and folders of results.

A folder of results has a manifest, ``.sonar_graph.json``, with the digest of every file in it that this package wrote.
Only these are replaced or removed, and only while they are as they were written. All files of a result change together,
when it is complete. Temporary files are new ones with random names, so that no other file and no link is written to; a
part of their names is in the manifest meanwhile, and what a killed command left is removed by the next one.
"""

import contextlib
import hashlib
import json
import os
import re
import secrets
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from sonar_graph.errors import EvaluationError, LogError, SonarGraphError
from sonar_graph.files.inputs import read_json, strict_json, text_of
from sonar_graph.files.interrupts import deferred_interrupt

MANIFEST = ".sonar_graph.json"
LOCK = ".lock"
COMPARISON = "comparison"
BATCH = "batch"
PAPER = "paper"
"""Kinds of results in the manifests of folders."""
FORMAT = "sonar_graph folder 1"
DIGEST_DIGITS = 32
_NAMED = 4
"""Most files that an error names."""
_LONGEST_NAME = 100
_TOKEN = re.compile("(?:[0-9a-f]{12})?")


class ResultFolder:
    """Folder to which this thread alone writes, as the kind of result that its manifest names.

    Raises ``refusal`` when the manifest cannot be read, or is of another kind of result.
    """

    def __init__(
        self, path: Path, kind: str, refusal: type[SonarGraphError], *, overwrite: bool
    ) -> None:
        self.path = path
        self.kind = kind
        self._refusal = refusal
        self._overwrite = overwrite
        self.is_writing = False
        self._digests: dict[str, list[str]] = {}
        self._staged: dict[str, Path] = {}
        self._gone: set[str] = set()
        self.token = ""
        manifest = path / MANIFEST
        if not os.path.lexists(manifest):
            return
        try:
            if manifest.is_symlink():
                raise ValueError("it is a link")
            content = json.loads(text_of(manifest))
            found = content["kind"]
            self._digests = content["files"]
            is_sound = all(
                isinstance(digests, list) and _is_below(name)
                for name, digests in self._digests.items()
            )
            is_sound &= (
                _TOKEN.fullmatch(left := content.get("unfinished", "")) is not None
            )
            if content["format"] != FORMAT or not is_sound:
                raise ValueError(f"expected the format {FORMAT!r}")
        except (
            OSError,
            ValueError,
            KeyError,
            TypeError,
            AttributeError,
            RecursionError,
        ) as error:
            raise refusal(
                f"{manifest}: is not as sonar-graph writes it ({error}); choose another folder"
            ) from error
        if found != kind:
            raise refusal(
                f"{path}: holds a {found}, and would become a {kind}; choose another folder with -o"
            )
        for partial in [
            *path.glob(f".{MANIFEST}.*.partial*"),
            *(path.glob(f".*.{left}*.partial*") if left else ()),
        ]:
            partial.unlink(missing_ok=True)

    @property
    def names(self) -> list[str]:
        """Names of the files that were written, relative to the folder."""
        return list(self._digests)

    def require(self, names: Iterable[str]) -> None:
        """Raise for files under these names that are others', unless they are to be overwritten."""
        links = [name for name in names if self._is_linked(name)]
        others = links or [
            name for name in names if not self._overwrite and not self._is_own(name)
        ]
        if others:
            told = ", ".join(others[:_NAMED]) + (
                f" and {len(others) - _NAMED} more" if len(others) > _NAMED else ""
            )
            advice = "choose another folder with -o" + (
                "" if links else ", or give --overwrite to replace this"
            )
            raise self._refusal(
                f"{self.path}: holds {told}, which sonar-graph did not write or others changed since; {advice}"
            )

    def _is_linked(self, name: str) -> bool:
        """Tell whether a folder on the way to a file is a link, or the file is a folder."""
        way = [self.path / parent for parent in Path(name).parents][:-1]
        return any(folder.is_symlink() for folder in way) or (self.path / name).is_dir()

    def _is_own(self, name: str) -> bool:
        """Tell whether there is no such file, or it is as this package wrote it."""
        path = self.path / name
        if not os.path.lexists(path):
            return True
        return (
            path.is_file()
            and not path.is_symlink()
            and digest_of(path) in self._digests.get(name, [])
        )

    def stage(self, name: str, partial: Path) -> None:
        """Keep a temporary file that replaces ``name`` when all is written."""
        if name in self._staged:
            self._staged[name].unlink(missing_ok=True)
        self._staged[name] = partial

    def as_written(self, name: str) -> Path:
        """Path of a file's present content."""
        return self._staged.get(name, self.path / name)

    def remove(self, names: Iterable[str]) -> None:
        """Remove files when all is written; one that was changed since stays, and is others' from now on."""
        self._gone |= set(names) & self._digests.keys()

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        self.is_writing = True
        self.token = secrets.token_hex(6)
        is_kept = os.path.lexists(self.path / MANIFEST)
        try:
            self._write_manifest()
            yield
            self._commit()
            is_kept = True
        finally:
            for partial in self._staged.values():
                partial.unlink(missing_ok=True)
            self._staged.clear()
            self._gone.clear()
            self.is_writing = False
            self.token = ""
            with contextlib.suppress(
                OSError
            ):  # then the next command removes what is no longer there
                if is_kept or self._digests:
                    self._write_manifest()
                else:
                    (self.path / MANIFEST).unlink(missing_ok=True)

    def _commit(self) -> None:
        """Remove and replace; killed in between, the manifest names both contents of each file."""
        with deferred_interrupt():
            new = {name: digest_of(partial) for name, partial in self._staged.items()}
            gone = [
                name
                for name in self._gone
                if self._is_own(name) and not self._is_linked(name)
            ]
            self._digests |= {
                name: [*self._digests.get(name, [])[-1:], digest]
                for name, digest in new.items()
            }
            self._write_manifest()
            for name in gone:
                (self.path / name).unlink(missing_ok=True)
                with contextlib.suppress(OSError):  # others' files are in it
                    if (parent := (self.path / name).parent) != self.path:
                        parent.rmdir()
            for name, partial in self._staged.items():
                (self.path / name).parent.mkdir(parents=True, exist_ok=True)
                partial.replace(self.path / name)
            kept = {
                name: digests
                for name, digests in self._digests.items()
                if name not in self._gone
            }
            self._digests = kept | {name: [digest] for name, digest in new.items()}

    def _write_manifest(self) -> None:
        write_manifest(self.path, self.kind, self._digests, self.token)


_held: dict[tuple[Path, int], ResultFolder] = {}


@contextmanager
def result_folder(
    path: Path,
    kind: str,
    *,
    overwrite: bool = False,
    refusal: type[SonarGraphError] = EvaluationError,
) -> Iterator[ResultFolder]:
    """Make a folder and keep every other command out of it while the block runs; unused, it is removed again.

    `result_written` of the same thread writes to it; ``overwrite`` of this block holds. The operating system releases
    the lock when the process ends, also by SIGKILL; the file that stays means nothing.

    Raises
    ------
    SonarGraphError
        As ``refusal``: when another command writes there, the file system has no locks, or the manifest cannot be read.
    OSError
        When the folder cannot be made.
    """
    with (
        folder_for_use(path),
        _locked(path, kind, refusal, overwrite=overwrite) as folder,
    ):
        yield folder


@contextmanager
def folder_for_use(path: Path) -> Iterator[None]:
    """Make a folder and its parents; those of them that nothing was put into are removed when the block ends."""
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for folder in made:
            with contextlib.suppress(OSError):  # something is in it
                folder.rmdir()


@contextmanager
def _locked(
    path: Path, kind: str, refusal: type[SonarGraphError], *, overwrite: bool
) -> Iterator[ResultFolder]:
    place = path.absolute(), threading.get_ident()
    is_new = not os.path.lexists(path / LOCK)
    flags = (
        os.O_RDWR
        | os.O_CREAT
        | getattr(os, "O_NOFOLLOW", 0)
        | getattr(os, "O_NONBLOCK", 0)
    )
    try:
        descriptor = os.open(path / LOCK, flags, 0o666)
    except OSError as error:
        raise refusal(
            f"{path / LOCK}: cannot be opened to keep other commands out ({error.strerror}); choose another folder "
            "with -o"
        ) from error
    try:
        try:
            _lock(descriptor)
            if os.fstat(descriptor).st_ino != (path / LOCK).stat().st_ino:
                raise BlockingIOError  # whoever had it has just removed it
        except (BlockingIOError, PermissionError, FileNotFoundError) as error:
            raise refusal(
                f"{path}: another command is writing to this folder; wait for its end, or choose another with -o"
            ) from error
        except OSError as error:
            raise refusal(
                f"{path}: cannot be locked against a second command ({error}); choose another file system with -o"
            ) from error
        _held[place] = ResultFolder(path, kind, refusal, overwrite=overwrite)
        try:
            yield _held[place]
        finally:
            del _held[place]
            if is_new and not (path / MANIFEST).exists():  # nothing was written
                (path / LOCK).unlink(missing_ok=True)
    finally:
        os.close(descriptor)


def _lock(descriptor: int) -> None:
    if sys.platform == "win32":
        import msvcrt

        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


@contextmanager
def result_written(
    path: Path, kind: str, *, overwrite: bool = False
) -> Iterator[ResultFolder]:
    """Replace and remove the files of a result all together, when the block ends without an error.

    A block within another of the same folder is part of it. Errors are those of `result_folder`; a file that is not
    this package's is one as soon as it would be replaced.
    """
    held = _held.get((path.absolute(), threading.get_ident()))
    with (
        result_folder(path, kind, overwrite=overwrite)
        if held is None
        else contextlib.nullcontext(held) as folder
    ):
        if folder.is_writing:
            yield folder
            return
        with folder._transaction():
            yield folder


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Temporary path with the suffix of ``path``, which replaces ``path`` when the block ends without an error.

    In a folder whose result is being written it replaces it together with the others.
    """
    folder, name = next(
        (
            (one, path.absolute().relative_to(root).as_posix())
            for (root, thread), one in _held.items()
            if thread == threading.get_ident()
            and one.is_writing
            and path.absolute().is_relative_to(root)
        ),
        (None, ""),
    )
    if folder is not None:
        folder.require([name])
    place, token = (
        (path, "") if folder is None else (folder.path / path.name, folder.token)
    )
    use = folder_for_use(path.parent) if folder is None else contextlib.nullcontext()
    with use, _new_file(place, token) as partial:
        yield partial
        if folder is None:
            partial.replace(path)
        else:
            folder.stage(name, partial)


@contextmanager
def _new_file(path: Path, token: str = "") -> Iterator[Path]:
    """Make an empty file beside a path, which nothing else has or links to; removed when the block fails."""
    partial = path.with_name(
        f".{path.name[:_LONGEST_NAME]}.{token}{secrets.token_hex(6)}.partial{path.suffix}"
    )
    with contextlib.ExitStack() as failure:
        with deferred_interrupt():
            os.close(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
            failure.callback(partial.unlink, missing_ok=True)
        yield partial
        failure.pop_all()


def write_manifest(
    folder: Path, kind: str, digests: dict[str, list[str]], unfinished: str = ""
) -> None:
    """Write the manifest of a folder: the digests of each file that is this package's.

    ``unfinished`` is in the names of temporary files, as long as there may be some.
    """
    content = {"format": FORMAT, "kind": kind, "files": digests} | (
        {"unfinished": unfinished} if unfinished else {}
    )
    with _new_file(folder / MANIFEST) as partial:
        partial.write_text(json.dumps(content, indent=1) + "\n", "utf-8")
        partial.replace(folder / MANIFEST)


def digest_of(path: Path) -> str:
    """BLAKE2 of a file's content, hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "blake2b").hexdigest()[:DIGEST_DIGITS]


def kind_of(folder: Path) -> str | None:
    """Kind of result in a folder by its manifest; None without one that can be read."""
    return str(_manifest_of(folder).get("kind", "")) or None


def _manifest_of(folder: Path) -> dict[str, Any]:
    """Manifest of a folder; empty where there is none that can be read."""
    with contextlib.suppress(EvaluationError):
        return read_json(folder / MANIFEST)
    return {}


def _written_in(folder: Path) -> set[Path]:
    """Files that a folder's manifest names, with manifest and lock, and a manifest that was half written."""
    lock = folder / LOCK
    # one with content is others'
    has_lock = lock.is_file() and not lock.is_symlink() and not lock.stat().st_size
    named = {
        MANIFEST,
        *([LOCK] if has_lock else []),
        *(path.name for path in folder.glob(f".{MANIFEST}.*.partial*")),
    }
    named |= {name for name in _manifest_of(folder).get("files", ()) if _is_below(name)}
    return {folder / name for name in named}


def others_in(folder: Path) -> list[str]:
    """Names of the files in a folder that its manifest does not name."""
    there = {
        path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir()
    }
    return sorted(
        path.relative_to(folder).as_posix() for path in there - _written_in(folder)
    )


def changed_in(folder: Path) -> list[str]:
    """Names of the files in a folder that somebody changed since they were written; an empty one holds nothing."""
    named = {
        folder / name: name
        for name in _manifest_of(folder).get("files", ())
        if _is_below(name)
    }
    whole = {
        path: name
        for path, name in named.items()
        if path.is_file() and path.stat().st_size
    }
    return [
        name
        for path, name in whole.items()
        if digest_of(path) not in _manifest_of(folder)["files"][name]
    ]


def remove_written(folder: Path) -> None:
    """Remove a folder with the files that its manifest names; others' files stay, and the folder with them."""
    links = {path for path in folder.rglob("*") if path.is_symlink() and path.is_dir()}
    for path in sorted(
        _written_in(folder), key=lambda path: path.name == MANIFEST
    ):  # the manifest last
        if not links & set(path.parents):
            path.unlink(missing_ok=True)
    for path in sorted(
        (path for path in folder.rglob("*") if path.is_dir()), reverse=True
    ):
        with contextlib.suppress(OSError):
            path.rmdir()
    with contextlib.suppress(OSError):
        folder.rmdir()


def _is_below(name: str) -> bool:
    return not Path(name).is_absolute() and ".." not in Path(name).parts


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write JSON atomically; NaN and infinity become null."""
    with replacing(path) as partial:
        partial.write_text(strict_json(content) + "\n", "utf-8")


@contextmanager
def written_whole(path: Path) -> Iterator[BinaryIO]:
    """Open a temporary file beside ``path``, which replaces ``path`` when the block ends without an error.

    Raises `LogError` when the file cannot be written.
    """
    try:
        with replacing(path) as partial, partial.open("wb") as stream:
            yield stream
    except OSError as error:
        raise LogError(f"{path} cannot be written: {error.strerror}") from error
