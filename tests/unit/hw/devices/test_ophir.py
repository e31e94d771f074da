"""The Ophir power meter."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from serial_fakes import BoardBench, LaserBench, MeterBench

from disco_twin.firmware.ophir import OphirFirmware
from disco_twin.firmware.wire import Fault, after, garbled, late, lost, split
from hw.base.errors import DeviceFault, DeviceRefused, NoAnswer, WrongDevice
from hw.devices.ophir import OphirMeter


def test_it_reads_power() -> None:
    bench = MeterBench()
    meter = bench.connect()
    assert meter.model == "VEGA"
    for watts in (1.23e-3, 0.0, 0.0299, 4.56e-9):
        bench.watts = watts
        assert meter.read() == pytest.approx(watts, rel=1e-3)


def test_an_overrange_is_named() -> None:
    bench = MeterBench(watts=0.031)
    with pytest.raises(DeviceFault, match="power meter is over its range"):
        bench.connect().read()


@pytest.mark.parametrize("make", [LaserBench, BoardBench])
def test_another_device_is_refused(make: Callable[[], LaserBench | BoardBench]) -> None:
    with pytest.raises(WrongDevice, match="power meter is not an Ophir meter"):
        OphirMeter(make().link("power meter"))


def test_another_meter_is_refused() -> None:
    bench = MeterBench()
    bench.line.firmware = OphirFirmware(lambda: 0.0, model="Toaster")
    with pytest.raises(WrongDevice, match="TOASTER"):
        bench.connect()


FAULTS: dict[str, Fault] = {
    "lost": lost,
    "late": late(1.2),
    "very late": late(2.0),
    "split": split(4),
    "split slowly": split(4, 0.8),
    "nuls": after(b"\0\0"),
    "garbage": after(b"\x93\r\n"),
    "garbled": garbled(0),
    "no number": lambda _: [(0.0, b"*1.2x3E-3\r\n")],
}


@pytest.mark.parametrize("name", FAULTS)
def test_one_bad_answer_costs_time_only(name: str) -> None:
    bench = MeterBench()
    meter = bench.connect()
    bench.line.answer_faults.append(FAULTS[name])
    bench.watts = 2e-3
    assert meter.read() == pytest.approx(2e-3)
    bench.watts = 5e-3
    assert meter.read() == pytest.approx(5e-3)


def test_errors_end_in_one_line() -> None:
    bench = MeterBench()
    meter = bench.connect()
    bench.line.answer_faults.append(lambda _: [(0.0, b"?NO HEAD\r\n")])
    with pytest.raises(DeviceRefused, match=r"refused \$SP \(NO HEAD\)"):
        meter.read()
    bench.line.answer_faults.extend([lost] * 9)
    with pytest.raises(NoAnswer, match=r"did not answer '\$SP' within 1 s"):
        meter.read()
