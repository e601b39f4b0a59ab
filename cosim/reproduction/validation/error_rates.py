"""Frames: how long they are on the air, and how many are received by their SINR."""

from collections.abc import Mapping, Sequence

import numpy as np

from vcmvsp.cosim.assembly.parts import channel_curves
from vcmvsp.cosim.reproduction.row import Row, absolute
from vcmvsp.cosim.reproduction.validation.channel_setup import channel, heard, line

BITS = 1088  # of a PSDU of 136 bytes
# By preset and model: SINR dB and success, as the error models of ns-3 say.
SUCCESS: Mapping[tuple[str, str], Sequence[tuple[float, float]]] = {
    ("wifi-b-1", "dsss"): ((-6.0, 0.114408641), (-5.2, 0.492387011), (-4.1, 0.90090911)),
    ("wifi-b-2", "dsss"): ((-1.8, 0.098592624), (-0.8, 0.503983425), (0.4, 0.897292683)),
    ("wifi-b-5.5", "dsss"): ((1.0, 0.097880127), (1.9, 0.489886115), (3.0, 0.892215516)),
    ("wifi-b-11", "dsss"): ((4.0, 0.09515186), (4.9, 0.484629977), (6.1, 0.908406873)),
    ("wifi-a-6", "yans"): ((-1.9, 0.115129482), (-1.2, 0.506310104), (-0.2, 0.909650688)),
    ("wifi-a-12", "yans"): ((0.9, 0.084900767), (1.7, 0.488377795), (2.7, 0.896574009)),
    ("wifi-a-24", "yans"): ((6.8, 0.110641195), (7.7, 0.479551247), (9.0, 0.907638945)),
    ("wifi-a-54", "yans"): ((16.4, 0.097598723), (17.2, 0.502460811), (18.2, 0.897385047)),
    ("wifi-a-6", "nist"): ((2.4, 0.113828396), (2.7, 0.472891842), (3.3, 0.908955549)),
    ("wifi-a-12", "nist"): ((5.4, 0.104814328), (5.7, 0.460088165), (6.3, 0.90585467)),
    ("wifi-a-24", "nist"): ((11.7, 0.067550663), (12.1, 0.466304622), (12.7, 0.886183479)),
    ("wifi-a-54", "nist"): ((20.8, 0.122778052), (21.2, 0.535521127), (21.8, 0.897401443)),
    ("zigbee", "oqpsk"): ((-1.5, 0.060843949), (-0.7, 0.481240135), (0.2, 0.894607301)),
}
# What its table needs for one half of a PSDU of 128 bytes, dB.
HALF_DB = {"6": -0.60, "9": 0.97, "12": 2.39, "18": 4.88, "24": 7.82, "36": 10.99, "48": 14.99, "54": 16.33}
# Of 20,000 broadcasts over one link: preset, model, received level dBm, payload bytes, how many arrived.
RECEIVED = (
    ("wifi-b-1", "dsss", -99.5, 1, 13870),
    ("wifi-b-11", "dsss", -89.0, 100, 10344),
    ("wifi-g-6", "yans", -94.5, 100, 16222),
    ("wifi-g-54", "yans", -76.5, 100, 10415),
    ("zigbee", "oqpsk", -87.0, 4, 12161),
    ("zigbee", "oqpsk", -86.0, 100, 11973),
)
SIZES = (1, 7, 100, 333, 1500, 2000)
AIR_US = {  # of broadcasts with these payloads
    "wifi-b-1": (488, 536, 1280, 3144, 12480, 16480),
    "wifi-b-2": (340, 364, 736, 1668, 6336, 8336),
    "wifi-b-5.5": (246, 255, 390, 729, 2427, 3154),
    "wifi-b-11": (219, 224, 291, 461, 1310, 1673),
    "wifi-a-6": (76, 84, 208, 516, 2072, 2740),
    "wifi-a-12": (48, 52, 116, 268, 1048, 1380),
    "wifi-a-24": (36, 36, 68, 144, 536, 700),
    "wifi-a-54": (28, 28, 44, 76, 248, 324),
    "zigbee": (576, 768, 3744),
}


def success() -> Sequence[Row]:
    """The error models behind ``vcmvsp per``."""
    rows = []
    for (preset, model), points in SUCCESS.items():
        errors, _ = channel_curves.error_rate(channel(preset).phy, model)
        sinr_db, expected = np.array(points).T
        within = 1e-6 if model == "oqpsk" else 1e-5
        for at, exact, share in zip(sinr_db, expected, errors.success(sinr_db, BITS), strict=True):
            rows.append(absolute(f"{preset}, {model}, {at:g} dB: success of {BITS} bits", exact, share, within))
    sinr_db = np.arange(-10.0, 30.0, 0.002)
    for rate, half_db in HALF_DB.items():
        errors, _ = channel_curves.error_rate(channel(f"wifi-a-{rate}").phy, "table")
        measured_db = float(np.interp(0.5, errors.success(sinr_db, 1024), sinr_db))
        rows.append(absolute(f"wifi-a-{rate}, table: SINR of one half, dB", half_db, measured_db, 0.1))
    return rows


def received() -> Sequence[Row]:
    """Noise, headers, filling bits and the curves together; within 3.5 standard deviations."""
    rows = []
    for preset, model, level_dbm, size, arrived in RECEIVED:
        on = channel(preset)
        errors, _ = channel_curves.error_rate(on.phy, model)
        snr_db = np.array([level_dbm - on.hearing.noise_dbm])
        chance = channel_curves.packet_errors(errors, snr_db, size)["success"][0]
        within = 3.5 * np.sqrt(chance * (1.0 - chance) / 20_000)
        rows.append(absolute(f"{preset}, {level_dbm:g} dBm, {size} bytes: share received", arrived / 20_000, chance, within))
    return rows


def air_time() -> Sequence[Row]:
    """Of frames that are sent."""
    sizes = {"zigbee": (1, 7, 100)}
    return [
        absolute(f"{preset}, {size} bytes: time on the air, us", us, _air_us(preset, size), 0.0)
        for preset, expected in AIR_US.items()
        for size, us in zip(sizes.get(preset, SIZES), expected, strict=True)
    ]


def _air_us(preset: str, size: int) -> float:
    return heard(channel(preset, mac={"kind": "ideal"}), line([1.0]), size_bytes=size).air_time_ns / 1e3
