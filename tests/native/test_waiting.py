"""Waiting threads sleep: spinning would take the processor from other programs."""

import os
import subprocess
import sys

import pytest


@pytest.mark.parametrize(("policy", "expected"), [(None, "passive"), ("active", "active")])
def test_waiting_threads_sleep_by_default(policy, expected):
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    if policy:
        environment["OMP_WAIT_POLICY"] = policy
    script = "import os, pcbench.native; print(os.environ['OMP_WAIT_POLICY'])"
    process = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    assert process.stdout.split() == [expected]
