"""Local servers of files, one of them with the answers of the Hugging Face Hub."""

import hashlib
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

COMMIT = "0123456789abcdef0123456789abcdef01234567"


@dataclass
class Files:
    """The files of a server, by path, and its faults.

    Attributes:
        content: Path -> bytes.
        cut: Path -> bytes after which the connection is closed.
        ranges: Whether it answers requests of a part of a file.
        requests: Method, path and first byte of every request.
    """

    content: dict[str, bytes]
    cut: dict[str, int] = field(default_factory=dict)
    ranges: bool = True
    requests: list[tuple[str, str, int]] = field(default_factory=list)
    url: str = ""

    @classmethod
    def of_folder(cls, folder: Path, prefix: str) -> "Files":
        """Serve the files of a folder below a prefix."""
        return cls(
            {
                f"{prefix}{path.relative_to(folder).as_posix()}": path.read_bytes()
                for path in folder.rglob("*")
                if path.is_file()
            }
        )

    def downloads(self, ending: str) -> list[int]:
        """Return the first bytes of the requests of the content of some files."""
        return [
            first
            for method, path, first in self.requests
            if method == "GET" and path.endswith(ending)
        ]


@contextmanager
def serve(files: Files) -> Iterator[Files]:
    """Serve files at ``files.url`` while the block runs."""

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_: Any) -> None:
            """Print nothing."""

        def do_HEAD(self) -> None:
            self._answer()

        def do_GET(self) -> None:
            self._answer()

        def _answer(self) -> None:
            content = files.content.get(self.path)
            wanted = self.headers.get("Range", "") if files.ranges else ""
            first = int(wanted.removeprefix("bytes=").partition("-")[0] or 0)
            files.requests.append((self.command, self.path, first))
            if content is None:
                self.send_response(404)
                if "/resolve/" in self.path:
                    self.send_header("X-Error-Code", "EntryNotFound")
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            last = int(wanted.partition("-")[2] or len(content) - 1)
            part = content[first : last + 1]
            self.send_response(206 if wanted else 200)
            self.send_header("Content-Length", str(len(part)))
            if files.ranges:
                self.send_header("Accept-Ranges", "bytes")
            if wanted:
                self.send_header(
                    "Content-Range", f"bytes {first}-{first + len(part) - 1}/{len(content)}"
                )  # fmt: skip
            self.send_header("ETag", f'"{hashlib.sha1(content).hexdigest()}"')
            self.send_header("X-Repo-Commit", COMMIT)
            self.end_headers()
            if self.command == "GET":
                cut = files.cut.get(self.path, len(content))
                self.wfile.write(part[: max(cut - first, 0)])
                self.wfile.flush()
                if self.path in files.cut:
                    time.sleep(0.3)  # the client has read the part before it fails
            self.close_connection = True

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    files.url = f"http://127.0.0.1:{server.server_address[1]}"
    try:
        yield files
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
