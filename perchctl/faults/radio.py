"""The lockstep's radio with faults: what arrives, what does not, and what comes late."""

from __future__ import annotations

from perchctl.faults.effects import (
    BlockDead,
    PacketLost,
    PacketTwice,
    Reboots,
    Silence,
    TelemetryDelayed,
)
from perchctl.link import BLOCKS_DELETED_AFTER_S, RESUME_PERIOD_S, Packet, Port, Radio
from perchctl.sim import PROTOCOL_VERSION, CommandService, Firmware

ORDERS = ("setpoint", "raw", "land", "notify", "stop", "emergency-stop")
"""The packets that faults can name."""

RadioEffect = Silence | PacketLost | PacketTwice | BlockDead | TelemetryDelayed | Reboots


def order_of(packet: Packet) -> str:
    """Which of `ORDERS` a packet is, or the empty string."""
    kind = packet.data[0] if packet.data else None
    match packet.port, packet.channel, kind:
        case Port.COMMANDER, 0, _:
            return "raw"
        case Port.COMMANDER_GENERIC, 0, 0:
            return "stop"
        case Port.COMMANDER_GENERIC, 0, _:
            return "setpoint"
        case Port.COMMANDER_GENERIC, 1, 0:
            return "notify"
        case Port.HIGH_LEVEL, 0, 8:
            return "land"
        case Port.SUPERVISOR, 1, 3:
            return "emergency-stop"
    return ""


class FaultyRadio(Radio):
    """Loses what `air` does, and nothing else until effects are begun. `cut` ends the uplink for
    good."""

    def __init__(self, air: Radio | None = None) -> None:
        self._air = air or Radio()
        self.cut = False
        self._begun: list[tuple[Silence | BlockDead | TelemetryDelayed, float]] = []
        self._left: dict[str, int] = {}  # packets of an order still to be lost
        self._twice: set[str] = set()
        self._service: CommandService | None = None

    def serves(self, firmware: Firmware) -> None:
        """Where the second copy of a packet goes."""
        self._service = CommandService(firmware, PROTOCOL_VERSION)

    def begin(self, effect: RadioEffect, now_s: float) -> None:
        match effect:
            case PacketLost(order, count):
                self._left[order] = count
            case PacketTwice(order):
                self._twice.add(order)
            case Reboots(boots_s):
                self._begun.append((Silence(boots_s, up=True, down=True), now_s))
                unasked_s = boots_s + BLOCKS_DELETED_AFTER_S + RESUME_PERIOD_S
                self._begun.append((Silence(unasked_s, up=False, down=True), now_s))
            case Silence() | BlockDead() | TelemetryDelayed():
                self._begun.append((effect, now_s))

    def up(self, packet: Packet, now_s: float) -> bool:
        if self.cut or not self._air.up(packet, now_s):
            return False
        order = order_of(packet)
        if self._left.get(order, 0) > 0:
            self._left[order] -= 1
            return False
        for effect, begin_s in self._begun:
            if isinstance(effect, Silence) and effect.up and now_s < begin_s + effect.for_s:
                return False
        if order in self._twice and self._service is not None:
            self._twice.remove(order)
            self._service.handle(packet)
        return True

    def down(self, block: str, now_s: float) -> float | None:
        delay_s = self._air.down(block, now_s)
        if delay_s is None:
            return None
        for effect, begin_s in self._begun:
            if now_s >= begin_s + effect.for_s:
                continue
            if isinstance(effect, Silence) and effect.down:
                return None
            if isinstance(effect, BlockDead) and effect.block == block:
                return None
            if isinstance(effect, TelemetryDelayed):
                delay_s = max(delay_s, effect.delay_s)
        return delay_s
