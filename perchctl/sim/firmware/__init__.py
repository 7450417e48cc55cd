"""The Crazyflie's firmware, release 2026.08, as far as its answers can be seen."""

from perchctl.sim.firmware.firmware import Firmware

__all__ = ["Firmware"]
