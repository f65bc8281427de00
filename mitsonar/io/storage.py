"""Storage of a data set: a folder, or an object storage by its URL (``s3://bucket/data.zarr``), through fsspec."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import zarr
from fsspec.core import url_to_fs
from fsspec.implementations.local import LocalFileSystem
from zarr.abc.store import Store

from mitsonar.errors import MitsonarError
from mitsonar.io.files import finite_number, parse_json

__all__ = ["Storage", "refuse_codecs"]

LOCK = "writer.json"
LOCK_FILE = "writer.lock"
"""The file whose lock is held on a file system. A folder cannot be locked on network file systems."""

HEARTBEAT_S = 20.0
"""Period at which the writer to an object storage renews its file; such a storage has no locks that end with their owner."""

STALE_S = 90.0
"""A writer whose file is older has ended."""


CODECS = ("BytesCodec", "BloscCodec", "Crc32cCodec", "GzipCodec", "ShardingCodec", "TransposeCodec", "ZstdCodec")
"""Codecs of Zarr that only rearrange bytes. Others come from packages that happen to be installed, or unpickle."""


def refuse_codecs(array: zarr.Array[Any]) -> None:
    """Refuse an array whose pieces are decoded by other codecs than :data:`CODECS`; nothing of it is decoded before.

    Raises:
        ValueError: it is.
    """
    rest: list[Any] = list(getattr(array.metadata, "codecs", ()))
    if array.metadata.zarr_format != 3:
        raise ValueError("it is of version 2 of Zarr's format, whose pieces may hold pickles")
    while rest:
        codec = rest.pop()
        rest += [*getattr(codec, "codecs", ()), *getattr(codec, "index_codecs", ())]
        if not (type(codec).__module__.startswith("zarr.codecs.") and type(codec).__name__ in CODECS):
            raise ValueError(f"its pieces need the codec {type(codec).__name__[:40]}, which is not read")


class Storage:
    """A folder of a local or remote file system.

    Args:
        url: path or URL.

    Raises:
        MitsonarError: unknown kind of storage, or its package is not installed.
    """

    def __init__(self, url: str | Path) -> None:
        self.url = str(url).rstrip("/")
        try:
            self.fs, self.root = url_to_fs(self.url)
        except (ValueError, ImportError) as error:
            raise MitsonarError(
                f"cannot use {self.url}: {error}; give a folder, or a URL that fsspec knows (pip install s3fs for s3://)"
            ) from None
        self.local = isinstance(self.fs, LocalFileSystem)

    def store(self, *, write: bool = False) -> Store:
        """Open the Zarr store here."""
        if self.local:
            return zarr.storage.LocalStore(self.root, read_only=not write)
        return zarr.storage.FsspecStore.from_url(self.url, read_only=not write)

    def sizes(self) -> dict[str, int]:
        """List the sizes in bytes of all files, by their path here, without the files of the lock.

        Raises:
            MitsonarError: the storage does not answer, or refuses access.
        """
        if self.local and os.path.isfile(self.root):
            raise MitsonarError(f"{self.url} is a file: give a folder, or a URL")
        try:
            self.fs.invalidate_cache()
            found = self.fs.find(self.root, detail=True)
        except FileNotFoundError:
            return {}
        except Exception as error:  # libraries of storages raise errors of many kinds
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            raise MitsonarError(
                f"cannot list {self.url}: {reason}; check the address, and for object storage its endpoint and credentials"
            ) from None
        files = {name[len(self.root) + 1 :]: int(entry["size"] or 0) for name, entry in found.items()}
        return {name: size for name, size in files.items() if name not in (LOCK, LOCK_FILE)}

    def read(self, name: str) -> bytes:
        """Read the bytes of a file."""
        return bytes(self.fs.cat_file(f"{self.root}/{name}"))

    def write(self, name: str, content: bytes) -> None:
        """Write a small file."""
        self.fs.pipe_file(f"{self.root}/{name}", content)

    def remove(self, name: str) -> None:
        """Remove a file; one that is absent is no error."""
        with contextlib.suppress(FileNotFoundError):
            self.fs.rm_file(f"{self.root}/{name}")

    @contextlib.contextmanager
    def locked(self) -> Iterator[Callable[[], None]]:
        """Hold the lock of the only writer. Yield a function that raises once the lock is lost; call it now and then.

        Raises:
            MitsonarError: another process holds the lock.
        """
        with self._locked_folder() if self.local else self._locked_objects() as still_ours:
            yield still_ours

    @contextlib.contextmanager
    def _locked_folder(self) -> Iterator[Callable[[], None]]:
        """Hold the kernel's lock on a file. It ends with the process, however that ends."""
        new = not os.path.exists(self.root)
        os.makedirs(self.root, exist_ok=True)
        path = os.path.join(self.root, LOCK_FILE)
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if not (os.path.exists(path) and os.path.samestat(os.fstat(handle), os.stat(path))):
                    raise BlockingIOError  # its last owner has just removed it, or another process has made a new one
            except BlockingIOError:
                raise MitsonarError(
                    f"another process is writing {self.url}: wait for it to end, or choose another -o; nothing was changed"
                ) from None
            try:
                yield lambda: None
            finally:
                with contextlib.suppress(OSError):
                    os.unlink(path)
                    if new:
                        os.rmdir(self.root)  # only if nothing was written
        finally:
            os.close(handle)

    @contextlib.contextmanager
    def _locked_objects(self) -> Iterator[Callable[[], None]]:
        """Hold a file that its owner renews. Another process takes over a file that is not renewed."""
        owner = f"{socket.gethostname()} {os.getpid()} {uuid.uuid4().hex}"
        self._refuse_if_written()
        self._renew(owner)
        time.sleep(0.5)  # of two that began at the same moment, the last writer keeps the lock
        self._refuse_if_written(besides=owner)
        done = threading.Event()
        lost = threading.Event()

        def renew() -> None:
            while not done.wait(HEARTBEAT_S):
                with contextlib.suppress(Exception):  # the storage may be away for a while
                    if self._owner() != owner:
                        return lost.set()
                    self._renew(owner)

        def still_ours() -> None:
            if lost.is_set():
                raise MitsonarError(
                    f"another process took {self.url} over, since this one had been silent for {STALE_S:.0f} s: it goes on "
                    "there; what this one wrote is whole"
                )

        thread = threading.Thread(target=renew, daemon=True)
        thread.start()
        try:
            yield still_ours
        finally:
            done.set()
            thread.join()
            with contextlib.suppress(Exception):
                if self._owner() == owner:
                    self.remove(LOCK)

    def _owner(self) -> str:
        """Read the name of the writer."""
        return str(parse_json(self.read(LOCK), LOCK)["owner"])

    def _renew(self, owner: str) -> None:
        """Write the owner and the time."""
        self.write(LOCK, json.dumps({"owner": owner, "time": time.time()}).encode())

    def _refuse_if_written(self, besides: str = "") -> None:
        try:
            found = parse_json(self.read(LOCK), LOCK)
            age = time.time() - finite_number(found["time"], "time")
            owner = str(found["owner"])
        except (FileNotFoundError, ValueError, KeyError, TypeError):  # nobody whom we could name
            return
        if owner != besides and age < STALE_S:
            host, process, *_ = [*owner.split(), "?"]
            raise MitsonarError(
                f"{self.url} is being written by process {process} on {host} (last sign {age:.0f} s ago): wait for it to "
                f"end, or, if it was killed, {STALE_S - age:.0f} s; nothing was changed"
            )
