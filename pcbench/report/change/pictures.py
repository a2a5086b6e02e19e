from pathlib import Path
def pictures(folder: Path, look): return {}
