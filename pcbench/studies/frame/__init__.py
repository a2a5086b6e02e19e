"""The frame of all studies: their folder, runs, records, rates, charts, tables and pages.

A study of many runs takes hours. All studies therefore work in the same way:

1. `check_folder` rejects a folder that holds something else before any work starts. `study_folder` locks the folder for
   one run and marks it with `study.json`, which also holds the settings of the last run.
2. `map_cells` runs cells that do not depend on each other, in this process or on workers. Slow results are saved for
   later runs: as a folder by `pcbench.plugins.stages.stage`, or as a JSON file by `write_record`, which `read_record`
   returns for the same inputs only. A failure that may be temporary (a full disk, a missing library) is raised and
   never saved.
3. `publish` writes the results for other programs, before anything that may fail is drawn from them; then the pictures;
   then the Markdown file and the page, from one article (`pcbench.report.article`).

A study has its factors, its runs, its judgement and its charts: a module with its result types, whose fields are the
keys of its document, and its `StudyKind`, which writes and reads that document.
"""
