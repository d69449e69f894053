"""A Hub on loopback: enough of the protocol for the real client, with faults on request."""

from __future__ import annotations

import base64
import hashlib
import json
import threading
import time
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, unquote, urlparse

TOKEN = "hf_loopback"
PART = 100_000
"""Files above this many bytes are uploaded in parts of it."""
LARGE = (".parquet", ".mp4", ".mcap", ".safetensors", ".png")


@dataclass
class Repo:
    """One repository: commits, and the names that point to them."""

    commits: dict[str, dict[str, bytes]] = field(default_factory=dict)
    branches: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)

    def resolve(self, revision: str) -> str | None:
        found = self.branches.get(revision) or self.tags.get(revision)
        return found or (revision if revision in self.commits else None)


class Hub:
    """A server in a thread; use as a context manager."""

    def __init__(self) -> None:
        self.repos: dict[tuple[str, str], Repo] = {}
        self.blobs: dict[str, bytes] = {}
        self.parts: dict[tuple[str, int], bytes] = {}
        self.uploads: list[str] = []
        """SHA-256 of every blob whose upload came to its end."""
        self.cut_after: int | None = None
        """Uploads from now on until the connection of one is cut in the middle, for good."""
        self.forge: dict[str, bytes] = {}
        """Path to bytes that are served in place of a file's own."""
        self.listed: list[dict[str, Any]] = []
        """Entries added to every listing."""
        self.lock = threading.Lock()
        hub = self

        class Handler(_Handler):
            server_hub = hub

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.endpoint = f"http://127.0.0.1:{self._server.server_port}"

    def __enter__(self) -> Hub:
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()

    def files(self, repo_type: str, repo_id: str, revision: str = "main") -> dict[str, bytes]:
        """Return path to content of a revision."""
        repo = self.repos[repo_type, repo_id]
        return repo.commits[repo.resolve(revision) or ""]


def is_large(path: str) -> bool:
    return path.endswith(LARGE)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server_hub: Hub

    def log_message(self, *_: object) -> None:
        """Say nothing."""

    def do_POST(self) -> None:
        self._dispatch("POST")

    def do_PUT(self) -> None:
        self._dispatch("PUT")

    def do_DELETE(self) -> None:
        self._dispatch("DELETE")

    def do_GET(self) -> None:
        self._dispatch("GET")

    def do_HEAD(self) -> None:
        self._dispatch("HEAD")

    def _dispatch(self, method: str) -> None:
        url = urlparse(self.path)
        words = [unquote(word) for word in url.path.strip("/").split("/")]
        query = parse_qs(url.query)
        if words[0] == "upload":
            return self._upload(words, query)
        body = self._body()
        if words[0] == "complete":  # like the parts, its address is the permission
            return self._complete(words[1], json.loads(body))
        trusted = self.headers.get("Authorization") == f"Bearer {TOKEN}"
        if method not in ("HEAD", "GET") and not trusted:
            return self._json({"error": "Invalid token"}, 401)
        if words[:3] == ["api", "repos", "create"]:
            return self._create(json.loads(body))
        if words[:2] == ["api", "validate-yaml"]:
            return self._json({"errors": [], "warnings": []})
        if "resolve" in words:
            at = words.index("resolve")
            kind = "dataset" if words[0] == "datasets" else "model"
            repo_id = "/".join(words[at - 2 : at])
            return self._resolve(kind, repo_id, words[at + 1], "/".join(words[at + 2 :]))
        if words[-3:] == ["lfs", "objects", "batch"]:
            return self._batch(json.loads(body))
        if words[0] == "api":
            kind, repo_id = words[1][:-1], "/".join(words[2:4])
            repo = self.server_hub.repos.get((kind, repo_id))
            if repo is None:
                return self._json({"error": "Repository not found"}, 404, "RepoNotFound")
            return self._repo(method, kind, repo_id, repo, words[4:], body)
        return self._json({"error": f"no route {self.path}"}, 404)

    def _repo(
        self, method: str, kind: str, repo_id: str, repo: Repo, words: list[str], body: bytes
    ) -> None:
        action = words[0] if words else "revision"
        if action == "refs":
            refs = {"branches": repo.branches, "tags": repo.tags}
            listed = {
                name: [
                    {
                        "name": n,
                        "ref": f"refs/{'heads' if name == 'branches' else 'tags'}/{n}",
                        "targetCommit": c,
                    }
                    for n, c in group.items()
                ]
                for name, group in refs.items()
            }
            return self._json({**listed, "converts": []})
        if action == "tag" and method == "DELETE":
            repo.tags.pop(words[1])
            return self._json({})
        revision = words[1] if len(words) > 1 else "main"
        commit = repo.resolve(revision)
        if commit is None:
            return self._json({"error": "no such revision"}, 404, "RevisionNotFound")
        if action == "revision":
            names = [{"rfilename": path} for path in repo.commits[commit]]
            answer = {
                "id": repo_id,
                "sha": commit,
                "siblings": names,
                "tags": [],
                "private": False,
                "downloads": 0,
                "likes": 0,
            }
            return self._json(answer)
        if action == "preupload":
            return self._preupload(repo.commits[commit], json.loads(body))
        if action == "commit":
            return self._commit(kind, repo_id, repo, commit, body)
        if action == "tag":
            repo.tags[json.loads(body)["tag"]] = commit
            return self._json({})
        if action == "tree":
            entries = [_entry(path, data) for path, data in repo.commits[commit].items()]
            return self._json(entries + self.server_hub.listed)
        return self._json({"error": f"no route {self.path}"}, 404)

    def _create(self, payload: dict[str, Any]) -> None:
        kind = payload.get("type", "model")
        repo_id = f"{payload['organization']}/{payload['name']}"
        prefix = "datasets/" if kind == "dataset" else ""
        answer = {"url": f"{self.server_hub.endpoint}/{prefix}{repo_id}", "name": repo_id}
        if (kind, repo_id) in self.server_hub.repos:
            return self._json({**answer, "error": "You already created this repo"}, 409)
        repo = Repo(commits={"0" * 40: {}}, branches={"main": "0" * 40})
        self.server_hub.repos[kind, repo_id] = repo
        return self._json(answer)

    def _preupload(self, tree: dict[str, bytes], payload: dict[str, Any]) -> None:
        files = []
        for file in payload["files"]:
            path = file["path"]
            entry = _entry(path, tree[path]) if path in tree else None
            oid = None
            if entry:
                oid = entry["lfs"]["oid"] if "lfs" in entry else entry["oid"]
            mode = "lfs" if is_large(path) else "regular"
            files.append({"path": path, "uploadMode": mode, "shouldIgnore": False, "oid": oid})
        return self._json({"files": files})

    def _batch(self, payload: dict[str, Any]) -> None:
        objects = []
        for item in payload["objects"]:
            oid, size = item["oid"], item["size"]
            answer: dict[str, Any] = {"oid": oid, "size": size}
            if oid not in self.server_hub.blobs:
                base = self.server_hub.endpoint
                upload: dict[str, Any] = {"href": f"{base}/upload/{oid}"}
                if size > PART:
                    count = -(-size // PART)
                    header = {str(n + 1): f"{base}/upload/{oid}/{n + 1}" for n in range(count)}
                    upload = {
                        "href": f"{base}/complete/{oid}",
                        "header": {"chunk_size": str(PART), **header},
                    }
                answer["actions"] = {"upload": upload}
            objects.append(answer)
        return self._json({"transfer": "basic", "objects": objects})

    def _upload(self, words: list[str], query: dict[str, Any]) -> None:
        hub = self.server_hub
        length = int(self.headers.get("Content-Length", 0))
        with hub.lock:
            cut = hub.cut_after is not None and len(hub.uploads) >= hub.cut_after
        if cut:
            self.rfile.read(min(length, 1000))
            self.close_connection = True
            self.connection.close()
            return
        data = self._body()
        with hub.lock:
            if len(words) == 3:
                hub.parts[words[1], int(words[2])] = data
            else:
                self._store(words[1], data)
        self.send_response(200)
        self.send_header("ETag", f'"{hashlib.md5(data).hexdigest()}"')
        self.send_header("Content-Length", "0")
        self.end_headers()

    def _complete(self, oid: str, payload: dict[str, Any]) -> None:
        hub = self.server_hub
        with hub.lock:
            data = b"".join(hub.parts[oid, part["partNumber"]] for part in payload["parts"])
            self._store(oid, data)
        return self._json({"success": True})

    def _store(self, oid: str, data: bytes) -> None:
        assert hashlib.sha256(data).hexdigest() == oid
        self.server_hub.blobs[oid] = data
        self.server_hub.uploads.append(oid)

    def _commit(self, kind: str, repo_id: str, repo: Repo, parent: str, body: bytes) -> None:
        tree = dict(repo.commits[parent])
        for line in body.splitlines():
            item = json.loads(line)
            value = item["value"]
            if item["key"] == "file":
                tree[value["path"]] = base64.b64decode(value["content"])
            elif item["key"] == "lfsFile":
                tree[value["path"]] = self.server_hub.blobs[value["oid"]]
            elif item["key"] == "deletedFile":
                del tree[value["path"]]
        seed = json.dumps([parent, sorted(tree), time.time()]).encode()
        oid = hashlib.sha1(seed).hexdigest()
        repo.commits[oid], repo.branches["main"] = tree, oid
        url = f"{self.server_hub.endpoint}/{kind}s/{repo_id}/commit/{oid}"
        return self._json({"commitUrl": url, "commitOid": oid})

    def _resolve(self, kind: str, repo_id: str, revision: str, path: str) -> None:
        repo = self.server_hub.repos.get((kind, repo_id))
        commit = repo.resolve(revision) if repo else None
        if repo is None or commit is None:
            return self._json({"error": "not found"}, 404, "RepoNotFound")
        if path not in repo.commits[commit]:
            return self._json({"error": "not found"}, 404, "EntryNotFound")
        data = repo.commits[commit][path]
        entry = _entry(path, data)
        served = self.server_hub.forge.get(path, data)
        self.send_response(200)
        self.send_header("X-Repo-Commit", commit)
        self.send_header("ETag", f'"{entry["lfs"]["oid"] if "lfs" in entry else entry["oid"]}"')
        self.send_header("Content-Length", str(len(served)))
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(served)

    def _body(self) -> bytes:
        if self.headers.get("Transfer-Encoding") == "chunked":
            data = b""
            while size := int(self.rfile.readline().strip(), 16):
                data += self.rfile.read(size)
                self.rfile.readline()
            self.rfile.readline()
            return data
        return self.rfile.read(int(self.headers.get("Content-Length", 0)))

    def _json(self, answer: Any, status: int = 200, code: str = "") -> None:
        data = json.dumps(answer).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        if code:
            self.send_header("X-Error-Code", code)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)


def _entry(path: str, data: bytes) -> dict[str, Any]:
    git = hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()
    entry: dict[str, Any] = {"type": "file", "path": path, "oid": git, "size": len(data)}
    if is_large(path):
        sha = hashlib.sha256(data).hexdigest()
        entry["lfs"] = {"oid": sha, "size": len(data), "pointerSize": 130}
    return entry
