"""The Crazyflie's firmware, release 2026.08, modelled as far as its answers can be observed."""

from perchctl.sim.firmware.firmware import Firmware

__all__ = ["Firmware"]
