"""Where things lie, for tests that look at files of the repository or start others of the tests."""

from pathlib import Path

TESTS = Path(__file__).parent
ROOT = TESTS.parent
