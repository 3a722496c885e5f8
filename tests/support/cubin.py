"""What a kernel takes on a GPU, read from its compiled form: a 64-bit ELF file with NVIDIA's sections."""

import dataclasses
import struct

_REGISTERS, _FRAME, _STACK = 0x2F, 0x11, 0x12
"""Attributes of the section `.nv.info`: (symbol, value) each."""
_PAIR = 0x04
"""Format of an attribute that is followed by its size and by that many bytes."""


@dataclasses.dataclass(frozen=True)
class Resources:
    """What a thread or a block needs."""

    registers: int  # of a thread
    stack: int  # bytes of local memory of a thread: spilled registers, arrays with computed indices, calls
    shared: int  # bytes of static shared memory of a block
    code: int  # bytes of instructions


def _sections(elf: bytes) -> dict[str, tuple[int, int]]:
    """Return offset and size of every section by name."""
    (table,), (count, names) = struct.unpack_from("<Q", elf, 0x28), struct.unpack_from("<HH", elf, 0x3C)
    headers = [struct.unpack_from("<IIQQQQ", elf, table + 64 * i) for i in range(count)]
    start = headers[names][4]
    return {elf[start + h[0] :].split(b"\0", 1)[0].decode(): (h[4], h[5]) for h in headers}


def resources(elf: bytes) -> Resources:
    """Return what the only kernel of a cubin takes."""
    sections = _sections(elf)
    at, size = sections[".nv.info"]
    end, found = at + size, dict.fromkeys((_REGISTERS, _FRAME, _STACK), 0)
    while at < end:
        form, attribute, value = struct.unpack_from("<BBH", elf, at)
        at += 4
        if form == _PAIR:
            if attribute in found:
                found[attribute] = max(found[attribute], struct.unpack_from("<II", elf, at)[1])
            at += value

    def total(prefix: str) -> int:
        return sum(size for name, (_, size) in sections.items() if name.startswith(prefix))

    assert found[_REGISTERS] and total(".text."), "no kernel in this file"
    return Resources(found[_REGISTERS], max(found[_FRAME], found[_STACK]), total(".nv.shared."), total(".text."))
