"""`python -m pcbench.cli`."""

from pcbench.cli import main

main()
