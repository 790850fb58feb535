"""Files that are either the old or the new one, never half of one."""

import os
from pathlib import Path


def replace(path, write) -> None:
    """Calls `write(temporary path)` and renames the result to `path`. The temporary file lies beside it."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        write(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
