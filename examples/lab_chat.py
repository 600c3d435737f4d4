"""A chat model in a laboratory, over any address that is compatible with OpenAI's.

Run it with ``python examples/lab_chat.py --url http://127.0.0.1:8080/v1 --model NAME``. The key is
read from ``OPENAI_API_KEY``. Nothing is contacted without ``--url``: then ``--replay run.json``
plays a recorded run in place of a model, and without that a scripted agent is recorded first.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from scm_world import lab

Message = dict[str, Any]
SYSTEM = (
    "You are in a laboratory. Find the answer to the question by experiments, within the budget. "
    "Call the tools; submit ends it. A call that is refused costs nothing and says why."
)
FUNCTIONS = [
    {
        "type": "function",
        "function": {
            "name": tool["name"],
            "description": tool["description"],
            "parameters": tool["input_schema"],
        },
    }
    for tool in lab.tools()
]


def model(url: str, name: str) -> Callable[[list[Message]], Message]:
    """Return a function that asks a chat model for its next message."""
    if not url.startswith(("http://", "https://")):
        raise SystemExit(f"--url {url}: give an address that begins with http:// or https://")
    key = os.environ.get("OPENAI_API_KEY", "")
    headers = {"Content-Type": "application/json", "Authorization": f"Bearer {key}"}

    def ask(messages: list[Message]) -> Message:
        body = json.dumps({"model": name, "messages": messages, "tools": FUNCTIONS}).encode()
        request = urllib.request.Request(f"{url.rstrip('/')}/chat/completions", body, headers)  # noqa: S310 # checked above
        with urllib.request.urlopen(request, timeout=600) as answer:  # noqa: S310
            found: Message = json.load(answer)["choices"][0]["message"]
        return found

    return ask


def recorded(run: dict[str, Any]) -> Callable[[list[Message]], Message]:
    """Return a function that gives the calls of a recorded run, one in each message."""

    def messages() -> Iterator[Message]:
        for number, call in enumerate(run["calls"]):
            function = {"name": call["tool"], "arguments": json.dumps(call["arguments"])}
            asked = [{"id": f"call{number}", "type": "function", "function": function}]
            yield {"role": "assistant", "content": None, "tool_calls": asked}

    coming = messages()
    return lambda _: next(coming)


def converse(room: lab.Laboratory, ask: Callable[[list[Message]], Message], turns: int) -> None:
    """Let a model call tools, until it has submitted an answer or has had its turns."""
    messages: list[Message] = [{"role": "system", "content": SYSTEM}]
    messages.append({"role": "user", "content": json.dumps(room.question.describe()["about"])})
    for _ in range(turns):
        messages.append(said := ask(messages))
        for call in (calls := said.get("tool_calls") or []):
            try:
                arguments = json.loads(call["function"]["arguments"] or "{}")
            except ValueError as error:
                found: Any = {"refused": f"the arguments are not JSON: {error}"}
            else:
                found = room.call(call["function"]["name"], arguments)
            answer = {"role": "tool", "tool_call_id": call["id"], "content": json.dumps(found)}
            messages.append(answer)
        if room.finished:
            return
        if not calls:
            messages.append({"role": "user", "content": "Call a tool; submit ends it."})


def main(given: Sequence[str] = ()) -> None:
    """Play one question, and print the score."""
    parser = argparse.ArgumentParser(description=__doc__)
    for flag, default in (("--kind", "effect"), ("--world", "equations"), ("--level", "L2")):
        parser.add_argument(flag, default=default)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--turns", type=int, default=60)
    for flag in ("--url", "--model", "--replay", "--out"):
        parser.add_argument(flag, default="")
    args = parser.parse_args(given)
    if args.url:
        question = lab.question(args.kind, args.world, args.seed, args.level)
        ask = model(args.url, args.model)
    else:
        with tempfile.TemporaryDirectory() as folder:
            if not args.replay:
                made = lab.question(args.kind, args.world, args.seed, args.level)
                args.replay = lab.play("ideal", made).save(Path(folder) / "run.json")
            run = json.loads(Path(args.replay).read_text())
        question, ask = lab.Question.of(run["question"]), recorded(run)
    room = lab.Laboratory(question)
    converse(room, ask, args.turns)
    if args.out:
        print("written:", room.save(args.out))
    print(room.score or f"no answer in {args.turns} turns")


if __name__ == "__main__":
    main(sys.argv[1:])
