"""Access the storage of a data set through fsspec: a folder, or an object storage by its URL (``s3://bucket/data.zarr``)."""

from __future__ import annotations

import contextlib
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
from mitsonar.io.system import exclusive_file

__all__ = ["Storage", "refuse_codecs"]

LOCK = "writer.json"
LOCK_FILE = "writer.lock"
"""File that is locked on a file system, since folders cannot be locked on network file systems."""

HEARTBEAT_S = 20.0
"""Interval at which the writer to an object storage renews its file [s].

An object storage has no locks that end with their owner.
"""

STALE_S = 90.0
"""Age of the file beyond which its writer is assumed to have ended [s]."""


CODECS = ("BytesCodec", "BloscCodec", "Crc32cCodec", "GzipCodec", "ShardingCodec", "TransposeCodec", "ZstdCodec")
"""Zarr codecs that only rearrange bytes.

Others may come from any installed package, or unpickle data.
"""


def refuse_codecs(array: zarr.Array[Any]) -> None:
    """Reject an array that needs codecs other than :data:`CODECS`, before any of it is decoded.

    Raises:
        ValueError: the array needs another codec.
    """
    pending: list[Any] = list(getattr(array.metadata, "codecs", ()))
    if array.metadata.zarr_format != 3:
        raise ValueError("it has version 2 of Zarr's format, whose chunks may contain pickles")
    while pending:
        codec = pending.pop()
        pending += [*getattr(codec, "codecs", ()), *getattr(codec, "index_codecs", ())]
        if not (type(codec).__module__.startswith("zarr.codecs.") and type(codec).__name__ in CODECS):
            raise ValueError(f"its chunks need the codec {type(codec).__name__[:40]}, which is not allowed")


class Storage:
    """A folder of a local or remote file system.

    Args:
        url: path or URL.

    Raises:
        MitsonarError: an unknown type of storage, or its package is not installed.
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
        """Open the folder as a Zarr store."""
        if self.local:
            return zarr.storage.LocalStore(self.root, read_only=not write)
        return zarr.storage.FsspecStore.from_url(self.url, read_only=not write)

    def sizes(self) -> dict[str, int]:
        """List the sizes in bytes of all files by relative path, without the lock files.

        Raises:
            MitsonarError: the storage does not respond, or refuses access.
        """
        if self.local and os.path.isfile(self.root):
            raise MitsonarError(f"{self.url} is a file: give a folder, or a URL")
        try:
            self.fs.invalidate_cache()
            entries = self.fs.find(self.root, detail=True)
        except FileNotFoundError:
            return {}
        except Exception as error:  # storage libraries raise many types of errors
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            raise MitsonarError(
                f"cannot list {self.url}: {reason}; check the address, and for object storage its endpoint and credentials"
            ) from None
        files = {name[len(self.root) + 1 :]: int(entry["size"] or 0) for name, entry in entries.items()}
        return {name: size for name, size in files.items() if name not in (LOCK, LOCK_FILE)}

    def read(self, name: str) -> bytes:
        """Read the bytes of a file."""
        return bytes(self.fs.cat_file(f"{self.root}/{name}"))

    def write(self, name: str, content: bytes) -> None:
        """Write a small file."""
        self.fs.pipe_file(f"{self.root}/{name}", content)

    def remove(self, name: str) -> None:
        """Remove a file, ignoring one that does not exist."""
        with contextlib.suppress(FileNotFoundError):
            self.fs.rm_file(f"{self.root}/{name}")

    @contextlib.contextmanager
    def locked(self) -> Iterator[Callable[[], None]]:
        """Hold the exclusive write lock, and yield a function that raises once the lock is lost; call it regularly.

        Raises:
            MitsonarError: another process holds the lock.
        """
        with self._locked_folder() if self.local else self._locked_objects() as check_lock:
            yield check_lock

    @contextlib.contextmanager
    def _locked_folder(self) -> Iterator[Callable[[], None]]:
        """Hold a kernel lock on a file, which is released when the process ends for any reason."""
        new = not os.path.exists(self.root)
        os.makedirs(self.root, exist_ok=True)
        with contextlib.ExitStack() as lock:
            try:
                lock.enter_context(exclusive_file(os.path.join(self.root, LOCK_FILE)))
            except BlockingIOError:
                raise MitsonarError(
                    f"another process is writing {self.url}: wait for it to end, or choose another -o; nothing was changed"
                ) from None
            try:
                yield lambda: None
            finally:
                lock.close()
                if new:
                    with contextlib.suppress(OSError):
                        os.rmdir(self.root)  # only if nothing was written

    @contextlib.contextmanager
    def _locked_objects(self) -> Iterator[Callable[[], None]]:
        """Hold a file that its owner renews. Another process takes over if the file is not renewed."""
        owner = f"{socket.gethostname()} {os.getpid()} {uuid.uuid4().hex}"
        self._refuse_if_written()
        self._renew(owner)
        time.sleep(0.5)  # of two processes that start at the same time, the last writer gets the lock
        self._refuse_if_written(except_owner=owner)
        done = threading.Event()
        lost = threading.Event()

        def renew() -> None:
            while not done.wait(HEARTBEAT_S):
                with contextlib.suppress(Exception):  # the storage may be unreachable for a while
                    if self._owner() != owner:
                        return lost.set()
                    self._renew(owner)

        def check_lock() -> None:
            if lost.is_set():
                raise MitsonarError(
                    f"another process has taken over {self.url}, because this one had not renewed its lock for "
                    f"{STALE_S:.0f} s: the other process continues; the files that this one wrote are complete"
                )

        thread = threading.Thread(target=renew, daemon=True)
        thread.start()
        try:
            yield check_lock
        finally:
            done.set()
            thread.join()
            with contextlib.suppress(Exception):
                if self._owner() == owner:
                    self.remove(LOCK)

    def _owner(self) -> str:
        """Read the name of the current writer."""
        return str(parse_json(self.read(LOCK), LOCK)["owner"])

    def _renew(self, owner: str) -> None:
        """Write the owner and the current time."""
        self.write(LOCK, json.dumps({"owner": owner, "time": time.time()}).encode())

    def _refuse_if_written(self, except_owner: str = "") -> None:
        try:
            lock = parse_json(self.read(LOCK), LOCK)
            age = time.time() - finite_number(lock["time"], "time")
            owner = str(lock["owner"])
        except (FileNotFoundError, ValueError, KeyError, TypeError):  # no identifiable writer
            return
        if owner != except_owner and age < STALE_S:
            host, process, *_ = [*owner.split(), "?"]
            raise MitsonarError(
                f"{self.url} is being written by process {process} on {host} (last sign {age:.0f} s ago): wait for it to "
                f"end, or, if it was killed, {STALE_S - age:.0f} s; nothing was changed"
            )
