"""A scripted agent behind an address that is compatible with OpenAI's: a stand-in for a model.

It answers questions of the kind ``effect``: it sets the cause to both values, and submits the
difference of the means. ``python scripted_model.py --port 8001``.
"""

from __future__ import annotations

import argparse
import json
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from statistics import fmean
from typing import Any


def reply(messages: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the next action of a conversation; each user message has an observation."""
    said = [text_of(one["content"]) for one in messages if one["role"] == "user"]
    seen = [json.loads(one)["observation"]["result"] for one in said]
    query = seen[0]["query"]
    if len(seen) <= 2:
        do = {query["cause"]: query[("from", "to")[len(seen) - 1]]}
        return {"tool_name": "experiment", "arguments": {"do": do, "n": 200}}
    low, high = (fmean(one["columns"][query["outcome"]]) for one in seen[1:3])
    return {"tool_name": "submit", "arguments": {"answer": high - low, "confidence": 0.9}}


def text_of(content: Any) -> str:
    """Return the text of a message, which may have parts."""
    return content if isinstance(content, str) else "".join(part["text"] for part in content)


class Handler(BaseHTTPRequestHandler):
    """Answers chat completions."""

    protocol_version = "HTTP/1.1"

    def do_POST(self) -> None:  # the name of the base class
        """Answer a request."""
        asked = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        said = {
            "role": "assistant",
            "content": json.dumps({"type": "call_tool", **reply(asked["messages"])}),
        }
        found = {"id": "1", "created": 0, "model": asked["model"]}
        choice = {"index": 0, "finish_reason": "stop"}
        usage = {"prompt_tokens": 1, "completion_tokens": 1, "total_tokens": 2}
        if asked.get("stream"):
            chunk = {**found, "object": "chat.completion.chunk", "usage": usage}
            chunk["choices"] = [{**choice, "delta": said}]
            kind, text = "text/event-stream", f"data: {json.dumps(chunk)}\n\ndata: [DONE]\n\n"
        else:
            whole = {**found, "object": "chat.completion", "usage": usage}
            whole["choices"] = [{**choice, "message": said}]
            kind, text = "application/json", json.dumps(whole)
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(text.encode())))
        self.end_headers()
        self.wfile.write(text.encode())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--port", type=int, default=8001)
    ThreadingHTTPServer(("127.0.0.1", parser.parse_args().port), Handler).serve_forever()
