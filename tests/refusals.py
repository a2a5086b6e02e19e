"""Error messages of refused files."""

from wording import check_error

from pcbench import read_cloud


def refusal(path, data=None, **options):
    """Return the message without the path that it starts with. Bytes or text are written to the path first."""
    if data is not None:
        path.write_bytes(data if isinstance(data, bytes | bytearray) else data.encode())
    with check_error() as caught:
        read_cloud(path, **options)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    return message[len(f"{path}: ") :]
