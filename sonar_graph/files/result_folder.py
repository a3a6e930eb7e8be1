"""Atomic writing, and folders of results.

A folder of results has a manifest, ``.sonar_graph.json``, with the digest of every file in it that this package wrote.
Only these are replaced or removed, and only while they are as they were written. The files of a result are written to
``.sonar_graph.partial`` in the folder first, and put in place together when the result is complete; what a killed
command left there is removed by the next one. A file outside of such a folder is written under a new random name beside
it, so that no other file and no link is written to.
"""

import contextlib
import hashlib
import os
import secrets
import shutil
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from io import BufferedIOBase
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal

from pydantic import AfterValidator, BaseModel

from sonar_graph.errors import EvaluationError, LogError, SonarGraphError
from sonar_graph.files.inputs import strict_json, text_of
from sonar_graph.files.interrupts import deferred_interrupt

MANIFEST = ".sonar_graph.json"
LOCK = ".lock"
STAGING = ".sonar_graph.partial"
COMPARISON = "comparison"
BATCH = "batch"
PAPER = "paper"
"""Kinds of results in the manifests of folders."""
DIGEST_DIGITS = 32
_NAMED = 4
"""Most files that an error names."""
_LONGEST_NAME = 100


def digest_of(stream: BufferedIOBase) -> str:
    """BLAKE2 of a file's content, hexadecimal."""
    return hashlib.file_digest(stream, "blake2b").hexdigest()[:DIGEST_DIGITS]


def _below(name: str) -> str:
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise ValueError("expected a path below the folder")
    return name


class Manifest(BaseModel):
    """Files in a folder that this package wrote."""

    format: Literal["sonar_graph folder 1"] = "sonar_graph folder 1"
    kind: str
    """Kind of result."""
    files: dict[Annotated[str, AfterValidator(_below)], list[str]]
    """Digests by path below the folder: of the last content and of the one before."""

    @classmethod
    def read(cls, folder: Path) -> "Manifest":
        """Manifest of a folder; OSError and ValueError where it is missing or not as this package writes it."""
        if (folder / MANIFEST).is_symlink():
            raise ValueError("it is a link")
        return cls.model_validate_json(text_of(folder / MANIFEST))

    @classmethod
    def found(cls, folder: Path) -> "Manifest":
        """Manifest of a folder; an empty one where none can be read."""
        with contextlib.suppress(OSError, ValueError):
            return cls.read(folder)
        return cls(kind="", files={})

    def write(self, path: Path) -> None:
        """Write the manifest to a file."""
        path.write_text(self.model_dump_json(indent=1) + "\n", "utf-8")

    def owns(self, folder: Path, name: str) -> bool:
        """True if a file is as this package wrote it, or is empty in its place, or is missing."""
        path = folder / name
        if not os.path.lexists(path):
            return True
        if name not in self.files or path.is_symlink() or not path.is_file():
            return False
        with path.open("rb") as stream:
            # a machine that lost power may have kept the name and not the content
            return not path.stat().st_size or digest_of(stream) in self.files[name]


def _is_linked(folder: Path, name: str) -> bool:
    """True if a folder on the way to a file is a link: what is behind it is others'."""
    return any((folder / part).is_symlink() for part in Path(name).parents)


class ResultFolder:
    """Folder to which this thread alone writes, as the kind of result that its manifest names.

    Raises ``refusal`` when the manifest cannot be read, or is of another kind of result.
    """

    def __init__(
        self, path: Path, kind: str, refusal: type[SonarGraphError], *, overwrite: bool
    ) -> None:
        self.path = path
        self.is_writing = False
        self._refusal = refusal
        self._overwrite = overwrite
        self._staging = path / STAGING
        self._removed: set[str] = set()
        self._manifest = Manifest(kind=kind, files={})
        if os.path.lexists(path / MANIFEST):
            try:
                self._manifest = Manifest.read(path)
            except (OSError, ValueError) as error:
                raise refusal(
                    f"{path / MANIFEST}: is not as sonar-graph writes it; choose another folder"
                ) from error
        if (found := self._manifest.kind) != kind:
            raise refusal(
                f"{path}: holds a {found}, and would become a {kind}; choose another folder with -o"
            )

    @property
    def names(self) -> list[str]:
        """Names of the files that were written, relative to the folder."""
        return list(self._manifest.files)

    def require(self, names: Iterable[str]) -> None:
        """Raise for files under these names that are others', unless they are to be overwritten."""
        links = [
            name
            for name in names
            if _is_linked(self.path, name) or (self.path / name).is_dir()
        ]
        owns = self._manifest.owns
        # not even --overwrite goes through a link
        others = links or [
            name for name in names if not self._overwrite and not owns(self.path, name)
        ]
        if not others:
            return
        named = ", ".join(others[:_NAMED])
        if len(others) > _NAMED:
            named += f" and {len(others) - _NAMED} more"
        advice = "" if links else ", or give --overwrite to replace this"
        raise self._refusal(
            f"{self.path}: holds {named}, which sonar-graph did not write or others changed since; "
            f"choose another folder with -o{advice}"
        )

    def staged(self, name: str) -> Path:
        """Path under which a file is written until the result is complete."""
        return self._staging / name

    def as_written(self, name: str) -> Path:
        """Path of a file's present content."""
        staged = self.staged(name)
        return staged if staged.exists() else self.path / name

    def remove(self, names: Iterable[str]) -> None:
        """Remove files when all is written; one that was changed since stays, and is others' from now on."""
        self._removed |= set(names) & self._manifest.files.keys()

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Put the files that the block writes in place together, and remove others, when it ends without an error."""
        try:
            if self._staging.is_dir():
                shutil.rmtree(self._staging)  # of a command that was killed
            self._staging.mkdir()
            self.is_writing = True
            yield
            with deferred_interrupt():
                self._commit()
        finally:
            self.is_writing = False
            self._removed.clear()
            if not self._staging.is_symlink():
                shutil.rmtree(self._staging, ignore_errors=True)

    def _commit(self) -> None:
        new = sorted(
            path.relative_to(self._staging).as_posix()
            for path in self._staging.rglob("*")
            if path.is_file()
        )
        old = [
            name
            for name in self._removed.difference(new)
            if self._manifest.owns(self.path, name) and not _is_linked(self.path, name)
        ]
        files = self._manifest.files
        for name in new:
            with self.staged(name).open("rb") as stream:
                # a kill in the middle leaves either content
                files[name] = [*files.get(name, [])[-1:], digest_of(stream)]
        # before the files: killed between two of them, each is known by its old or its new content
        self._manifest.write(self.staged(MANIFEST))
        self.staged(MANIFEST).replace(self.path / MANIFEST)
        for name in old:
            path = self.path / name
            path.unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # other files are in it
                if path.parent != self.path:
                    path.parent.rmdir()
        for name in new:
            (self.path / name).parent.mkdir(parents=True, exist_ok=True)
            self.staged(name).replace(self.path / name)
        for name in self._removed.difference(new):
            del files[name]


_held: ContextVar[tuple[ResultFolder, ...]] = ContextVar("_held", default=())
"""Folders that this thread writes to."""


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
    with folder_for_use(path), _locked(path, refusal):
        folder = ResultFolder(path, kind, refusal, overwrite=overwrite)
        token = _held.set((*_held.get(), folder))
        try:
            yield folder
        finally:
            _held.reset(token)


@contextmanager
def folder_for_use(path: Path) -> Iterator[None]:
    """Make a folder and its parents; those of them that nothing was put into are removed when the block ends."""
    # deepest first, in which order they are removed again
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for folder in made:
            with contextlib.suppress(OSError):  # something is in it
                folder.rmdir()


@contextmanager
def _locked(path: Path, refusal: type[SonarGraphError]) -> Iterator[None]:
    lock = path / LOCK
    is_new = not os.path.lexists(lock)
    # a link would lock a file elsewhere, and a pipe would wait for its reader
    flags = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    try:
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | flags, 0o666)
    except OSError as error:
        raise refusal(
            f"{lock}: cannot be opened to keep other commands out ({error.strerror}); choose another folder with -o"
        ) from error
    try:
        try:
            _lock(descriptor)
            if os.fstat(descriptor).st_ino != lock.stat().st_ino:
                raise BlockingIOError  # whoever had it has just removed it
        except (BlockingIOError, PermissionError, FileNotFoundError) as error:
            raise refusal(
                f"{path}: another command is writing to this folder; wait for its end, or choose another with -o"
            ) from error
        except OSError as error:
            raise refusal(
                f"{path}: cannot be locked against a second command ({error}); choose another file system with -o"
            ) from error
        try:
            yield
        finally:
            if is_new and not (path / MANIFEST).exists():  # nothing was written
                lock.unlink(missing_ok=True)
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
    held = [one for one in _held.get() if one.path.absolute() == path.absolute()]
    with contextlib.ExitStack() as stack:
        folder = (
            held[0]
            if held
            else stack.enter_context(result_folder(path, kind, overwrite=overwrite))
        )
        if not folder.is_writing:
            stack.enter_context(folder.writing())
        yield folder


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Temporary path with the suffix of ``path``, which replaces ``path`` when the block ends without an error.

    In a folder whose result is being written it replaces it together with the others.
    """
    target = path
    for folder in _held.get():
        root = folder.path.absolute()
        if folder.is_writing and path.absolute().is_relative_to(root):
            name = path.absolute().relative_to(root).as_posix()
            folder.require([name])
            target = folder.staged(name)
    partial = target.with_name(
        f".{path.name[:_LONGEST_NAME]}.{secrets.token_hex(12)}.partial{path.suffix}"
    )
    with folder_for_use(target.parent), contextlib.ExitStack() as failure:
        with deferred_interrupt():
            # exclusive: nothing else has the file or links to it
            os.close(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
            failure.callback(partial.unlink, missing_ok=True)
        yield partial
        partial.replace(target)
        failure.pop_all()


def others_in(folder: Path) -> list[str]:
    """Names of the files in a folder that are not as this package wrote them."""
    manifest = Manifest.found(folder)
    names = [
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_symlink() or not path.is_dir()
    ]
    return sorted(
        name
        for name in names
        if not _is_service_file(folder, name) and not manifest.owns(folder, name)
    )


def _is_service_file(folder: Path, name: str) -> bool:
    """True if a file is the manifest or the lock; a lock with content is others'."""
    path = folder / name
    is_lock = name == LOCK and not path.is_symlink() and path.stat().st_size == 0
    return name == MANIFEST or is_lock


def remove_written(folder: Path) -> None:
    """Remove a folder with the files that its manifest names; others' files stay, and the folder with them."""
    for name in Manifest.found(folder).files:
        if not _is_linked(folder, name):
            (folder / name).unlink(missing_ok=True)
    for path in sorted(folder.rglob("*"), reverse=True):
        with contextlib.suppress(OSError):  # a file, or a folder with others' files
            path.rmdir()
    # the manifest last: killed before, the next command knows the rest
    for name in (LOCK, MANIFEST):
        if os.path.lexists(folder / name) and _is_service_file(folder, name):
            (folder / name).unlink()
    with contextlib.suppress(OSError):
        folder.rmdir()


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write JSON atomically; NaN and infinity become null."""
    with replacing(path) as partial:
        partial.write_text(strict_json(content) + "\n", "utf-8")


@contextmanager
def refused(
    path: Path, refusal: type[SonarGraphError], advice: str = ""
) -> Iterator[None]:
    """Raise a ``refusal`` that names the path, and the advice, where the system does not let the block write."""
    try:
        yield
    except OSError as error:
        why = f"{path}: cannot be written: {error.strerror or error}"
        raise refusal("; ".join(filter(None, [why, advice]))) from error


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
