"""A worker process: run calls from standard input until it is closed, and write their outcomes to standard output."""

from __future__ import annotations

import os
import pickle
import sys
from typing import IO

from pcbench.tasks.calls import portable, receive, send


def main() -> None:
    """Answer calls with the size of the result's file, or with the exception that the function raised."""
    calls = sys.stdin.buffer
    # Libraries that print must not write between the answers.
    answers: IO[bytes] = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    while True:
        try:
            message = receive(calls)
        except EOFError:
            return
        answer: int | Exception
        try:
            answer = pickle.loads(message).run()
        except Exception as error:
            answer = portable(error)
        send(answers, pickle.dumps(answer))


if __name__ == "__main__":
    main()
