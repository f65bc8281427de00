"""Where a store lies: a folder, or an object storage by its URL (``s3://bucket/data.zarr``), through fsspec."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import socket
import threading
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import zarr
from fsspec.core import url_to_fs
from fsspec.implementations.local import LocalFileSystem
from zarr.abc.store import Store

from mitsonar.errors import MitsonarError

__all__ = ["Place"]

LOCK = "writer.json"
HEARTBEAT_S = 20.0
"""An object storage has no locks that end with their owner: its writer says every so often that it lives."""

STALE_S = 90.0
"""A writer that was silent for so long is gone."""


class Place:
    """A folder of a file system.

    Args:
        url: path or URL.

    Raises:
        MitsonarError: no such kind of storage, or the package for it is not installed.
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
        """The Zarr store here."""
        if self.local:
            return zarr.storage.LocalStore(self.root, read_only=not write)
        return zarr.storage.FsspecStore.from_url(self.url, read_only=not write)

    def sizes(self, below: str = "") -> dict[str, int]:
        """Sizes in bytes of all files, by their path here."""
        try:
            found = self.fs.find(f"{self.root}/{below}".rstrip("/"), detail=True)
        except FileNotFoundError:
            return {}
        return {name[len(self.root) + 1 :]: int(entry["size"] or 0) for name, entry in found.items()}

    def read(self, name: str) -> bytes:
        """The bytes of a file."""
        return bytes(self.fs.cat_file(f"{self.root}/{name}"))

    def write(self, name: str, content: bytes) -> None:
        """Write a small file."""
        self.fs.pipe_file(f"{self.root}/{name}", content)

    def remove(self, name: str) -> None:
        """Remove a file; it may be gone already."""
        with contextlib.suppress(FileNotFoundError):
            self.fs.rm_file(f"{self.root}/{name}")

    def exists(self) -> bool:
        """Whether anything is here."""
        if self.local:
            return os.path.exists(self.root) and (not os.path.isdir(self.root) or bool(os.listdir(self.root)))
        self.fs.invalidate_cache()
        return bool(self.sizes())

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Be the only one who writes here.

        Raises:
            MitsonarError: somebody else writes.
        """
        with self._locked_folder() if self.local else self._locked_objects():
            yield

    @contextlib.contextmanager
    def _locked_folder(self) -> Iterator[None]:
        """The kernel's lock on the folder: it ends with the process, however that ends."""
        os.makedirs(self.root, exist_ok=True)
        handle = os.open(self.root, os.O_RDONLY)
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise MitsonarError(
                    f"another process is writing {self.url}: wait for it to end, or choose another -o; nothing was changed"
                ) from None
            yield
        finally:
            os.close(handle)

    @contextlib.contextmanager
    def _locked_objects(self) -> Iterator[None]:
        """A file that its owner renews; whoever finds a silent one takes it over."""
        owner = f"{socket.gethostname()} {os.getpid()} {uuid.uuid4().hex}"
        self._refuse_if_written()
        self._say(owner)
        time.sleep(0.5)  # two that began at the same moment: the one that wrote last stays
        self._refuse_if_written(besides=owner)
        done = threading.Event()
        lost: list[str] = []

        def renew() -> None:
            while not done.wait(HEARTBEAT_S):
                try:
                    self._say(owner)
                except Exception as error:  # the storage may be away for a while
                    lost.append(str(error))

        thread = threading.Thread(target=renew, daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()
            self.remove(LOCK)

    def _say(self, owner: str) -> None:
        self.write(LOCK, json.dumps({"owner": owner, "time": time.time()}).encode())

    def _refuse_if_written(self, besides: str = "") -> None:
        self.fs.invalidate_cache()
        try:
            found: dict[str, Any] = json.loads(self.read(LOCK))
            age = time.time() - float(found["time"])
            owner = str(found["owner"])
        except (FileNotFoundError, ValueError, KeyError, TypeError):
            return
        if owner != besides and age < STALE_S:
            host, process, *_ = [*owner.split(), "?"]
            raise MitsonarError(
                f"{self.url} is being written by process {process} on {host} (last sign {age:.0f} s ago): wait for it to "
                f"end, or, if it was killed, {STALE_S - age:.0f} s; nothing was changed"
            )
