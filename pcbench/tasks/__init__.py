"""Run many independent tasks on local processes or on a Dask cluster; each result is stored on disk.

A killed run continues: tasks whose results are stored and intact are not run again.
"""

from pcbench.tasks.results import StageResults as StageResults
from pcbench.tasks.results import Task as Task
from pcbench.tasks.runner import TaskRunner as TaskRunner
from pcbench.tasks.runner import Workers as Workers
