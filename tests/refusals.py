"""What a reader says of a file that it refuses."""

import pytest

from pcbench import read_cloud
from pcbench.errors import InputError


def refusal(path, data=None, **options):
    """The message without the path that it must start with; one line. Bytes or text are written to the path first."""
    if data is not None:
        path.write_bytes(data if isinstance(data, bytes | bytearray) else data.encode())
    with pytest.raises(InputError) as caught:
        read_cloud(path, **options)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message[len(f"{path}: ") :]
