"""The protocols by name."""

from __future__ import annotations

from pcbench.errors import InputError, did_you_mean
from pcbench.measure.protocols.dtu import Dtu
from pcbench.measure.protocols.eth3d import Eth3d
from pcbench.measure.protocols.indoor_meshes import IndoorMeshes
from pcbench.measure.protocols.preset import PRESET_PROTOCOLS
from pcbench.measure.protocols.protocol import BenchmarkProtocol, parse_settings
from pcbench.measure.protocols.tnt import TanksAndTemples

_KINDS: tuple[type[BenchmarkProtocol], ...] = (*PRESET_PROTOCOLS, Dtu, Eth3d, TanksAndTemples, IndoorMeshes)
PROTOCOLS = {kind.name: kind for kind in _KINDS}


def parse_protocol(text: str) -> BenchmarkProtocol:
    """Return the protocol of a text NAME or NAME:SETTING=VALUE,... such as `dtu:thinning=0.5`.

    Raises:
        InputError: there is no such protocol or setting, or a value is invalid.
    """
    name, _, settings = text.partition(":")
    if name not in PROTOCOLS:
        hint = did_you_mean(name, PROTOCOLS)
        raise InputError(f"unknown protocol {name!r}: expected one of {', '.join(PROTOCOLS)}{hint}")
    return parse_settings(PROTOCOLS[name], settings)
