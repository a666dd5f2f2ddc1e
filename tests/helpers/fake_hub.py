"""A Hugging Face Hub in memory, on loopback: enough of its interface for uploads, tags, listings and
downloads."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote

TOKEN = "hf_only_this_one_may_write"


class Hub:
    """Repositories by ``type/user/name``, and every request that came in.

    Attributes:
        repos: Key → ``files`` (path → content), ``private``, ``tags`` (name → commit), ``commits``.
        requests: (method, path) in order.
    """

    def __init__(self) -> None:
        self.repos: dict[str, dict[str, Any]] = {}
        self.requests: list[tuple[str, str]] = []
        hub = self

        class Handler(_Handler):
            pass

        Handler.hub = hub
        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def close(self) -> None:
        self.server.shutdown()
        self.server.server_close()


class _Handler(BaseHTTPRequestHandler):
    hub: Hub

    def log_message(self, format: str, *args: Any) -> None: ...

    def answer(self, status: int, value: Any, **headers: str) -> None:
        body = json.dumps(value).encode()
        self.send_response(status)
        for name, text in {"Content-Type": "application/json", "Content-Length": str(len(body))}.items():
            self.send_header(name, text)
        for name, text in headers.items():
            self.send_header(name.replace("_", "-"), text)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def body(self) -> bytes:
        if self.headers.get("Transfer-Encoding") == "chunked":
            out = b""
            while size := int(self.rfile.readline(), 16):
                out += self.rfile.read(size)
                self.rfile.readline()
            self.rfile.readline()
            return out
        return self.rfile.read(int(self.headers.get("Content-Length", 0)))

    def handle_request(self) -> None:
        path = self.path.split("?")[0]
        self.hub.requests.append((self.command, path))
        data = self.body()
        writes = self.command not in ("GET", "HEAD") and not path.endswith("validate-yaml")
        if writes and self.headers.get("Authorization") != f"Bearer {TOKEN}":
            return self.answer(401, {"error": "Invalid username or password."})
        if path == "/api/validate-yaml":
            return self.answer(200, {"errors": [], "warnings": []})
        if path == "/api/repos/create":
            wanted = json.loads(data)
            kind = wanted.get("type", "model")
            key = f"{kind}s/{wanted.get('organization') or 'user'}/{wanted['name'].split('/')[-1]}"
            if key in self.hub.repos:
                return self.answer(409, {"error": "You already created this repo", "url": key})
            self.hub.repos[key] = {
                "files": {".gitattributes": b""},
                "private": wanted.get("private", wanted.get("visibility") == "private"),
                "tags": {},
                "commits": 1,
            }
            return self.answer(200, {"url": f"{self.hub.url}/{key.removeprefix('models/')}"})
        match = re.fullmatch(r"/(datasets/[^/]+/[^/]+)/resolve/([^/]+)/(.+)", path)
        if match is not None:
            return self.download(match[1], unquote(match[3]))
        match = re.fullmatch(r"/api/((?:datasets|models)/[^/]+/[^/]+)(/.*)?", path)
        if match is None:
            return self.answer(404, {"error": path})
        repo, rest = self.hub.repos.get(match[1]), match[2] or ""
        if repo is None:
            return self.answer(404, {"error": "Repository not found"}, X_Error_Code="RepoNotFound")
        commit = f"{repo['commits']:040x}"
        if rest == "" or rest.startswith("/revision/"):
            return self.answer(200, self.info(match[1], repo, commit))
        if rest.startswith("/preupload/"):
            files = json.loads(data)["files"]
            regular = [
                {"path": one["path"], "uploadMode": "regular", "shouldIgnore": False, "oid": None}
                for one in files
            ]
            return self.answer(200, {"files": regular})
        if rest.startswith("/commit/"):
            for line in data.splitlines():
                one = json.loads(line)
                value = one["value"]
                if one["key"] == "file":
                    repo["files"][value["path"]] = base64.b64decode(value["content"])
                elif one["key"] == "deletedFile":
                    del repo["files"][value["path"]]
            repo["commits"] += 1
            commit = f"{repo['commits']:040x}"
            url = f"{self.hub.url}/{match[1].removeprefix('models/')}/commit/{commit}"
            return self.answer(
                200, {"success": True, "commitOid": commit, "commitUrl": url, "hookOutput": ""}
            )
        if rest.startswith("/tree/"):
            tree = [
                {"type": "file", "path": name, "size": len(content), "oid": "0" * 40}
                for name, content in repo["files"].items()
            ]
            return self.answer(200, tree)
        if rest == "/refs":
            branches = [{"name": "main", "ref": "refs/heads/main", "targetCommit": commit}]
            tags = [
                {"name": name, "ref": f"refs/tags/{name}", "targetCommit": at}
                for name, at in repo["tags"].items()
            ]
            return self.answer(200, {"branches": branches, "converts": [], "tags": tags})
        if rest.startswith("/tag/"):
            name = rest.removeprefix("/tag/")
            if self.command == "DELETE":
                if name not in repo["tags"]:
                    return self.answer(404, {"error": "Revision not found"}, X_Error_Code="RevisionNotFound")
                del repo["tags"][name]
            else:
                repo["tags"][json.loads(data)["tag"]] = commit
            return self.answer(200, {})
        return self.answer(404, {"error": path})

    def download(self, key: str, name: str) -> None:
        """Every revision is the newest."""
        repo = self.hub.repos.get(key)
        if repo is None:
            return self.answer(404, {"error": "Repository not found"}, X_Error_Code="RepoNotFound")
        content = repo["files"].get(name)
        if content is None:
            return self.answer(404, {"error": "Entry not found"}, X_Error_Code="EntryNotFound")
        self.send_response(200)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("ETag", f'"{hashlib.sha1(content).hexdigest()}"')
        self.send_header("X-Repo-Commit", f"{repo['commits']:040x}")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)
        return None

    def info(self, key: str, repo: dict[str, Any], commit: str) -> dict[str, Any]:
        return {
            "id": key.split("/", 1)[1],
            "_id": "0",
            "sha": commit,
            "private": repo["private"],
            "tags": [],
            "downloads": 0,
            "likes": 0,
            "siblings": [{"rfilename": name} for name in repo["files"]],
        }

    do_GET = do_POST = do_DELETE = do_HEAD = handle_request
