"""Names of the devices on which torch computes, without torch."""

from __future__ import annotations

from surrogates.errors import SurrogateError

DEVICES = ("cpu", "cuda", "mps")


def check_device_name(choice: str) -> None:
    """Raise SurrogateError where `choice` is neither auto nor a device, with or without a number (cuda:1)."""
    if choice != "auto" and choice.split(":")[0] not in DEVICES:
        raise SurrogateError(f"device {choice!r} is not known; choose {', '.join(DEVICES)} or auto")
