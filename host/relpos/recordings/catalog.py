"""The public sources of the recordings that the published figures rest on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from relpos.recordings import handheld, lowerback
from relpos.recordings.tables import Archive, ConvertedRun

Convert = Callable[[Archive], Iterator[ConvertedRun]]


@dataclass(frozen=True)
class Source:
    """One set: its repository at a commit, and what `get` makes of it.

    ``sha256`` is that of all converted tables (`tables.digest`); without a converter the set is
    listed only.
    """

    name: str
    repository: str
    licence: str
    holds: str
    commit: str = ""
    convert: Convert | None = None
    sha256: str = ""

    @property
    def address(self) -> str:
        """What is downloaded, or the page of the source."""
        page = f"https://{self.repository}"
        return f"{page}/archive/{self.commit}.zip" if self.commit else page


SOURCES = (
    Source(
        "walk_lowerback_20m",
        "github.com/CyrilVoisard/ipol_dataset_1",
        "AGPL-3.0",
        "lower back, 10 m there and back, foot contacts",
        "b9f4bbb3758135b877acf1676da3e5bae527314b",
        lowerback.convert,
        "1c0d487c7346e63eef7bd835475d08af6bc89a13dfa9f57fa8b2f050dbcf47a9",
    ),
    Source(
        "walk_handheld_waypoints",
        "github.com/location-competition/indoor-location-competition-20",
        "MIT",
        "phone in the hand, surveyed points (site1/F1)",
        "8ab177cd7be2700442714b7d13fa452bedc685f5",
        handheld.convert,
    ),
    Source(
        "walk_daily_lowerback",
        "github.com/mobilise-d/mobgap",
        "Apache-2.0",
        "lower back, slow indoor activity",
    ),
    Source(
        "walk_chest",
        "github.com/eternalamit5/"
        "An-improved-wearable-multi-sensor-fusion-Pedestrian-Dead-Reckoning-system",
        "MIT",
        "chest, one corridor both ways",
    ),
    Source(
        "walk_treadmill_stroke_lumbar",
        "github.com/SintMaartenskliniek/MovingReality",
        "MIT",
        "lower back on a treadmill, after a stroke",
    ),
    Source("walk_5m_back", "github.com/Marpino/Walking-dataset", "none stated", "back, 5 m"),
    Source("walk_author_back", "github.com/Marpino/Walking-dataset", "none stated", "back, loops"),
    Source(
        "walk_mocap_virtual",
        "github.com/NikonPic/imu_gait_analysis",
        "none stated",
        "motion capture, virtual IMU; stairs_mocap_virtual too",
    ),
    Source(
        "walk_phone_strides",
        "github.com/Archeries/StrideLengthEstimation",
        "none stated",
        "phone before the chest, every stride",
    ),
    Source(
        "walk_phone_museum",
        "zenodo.org/records/8362205",
        "see there",
        "phone in the hand, surveyed points (IPIN 2023 track 3)",
    ),
    Source(
        "still_mpu9150_8chips",
        "github.com/hcarlsso/Self-Calibration-Inertial-Sensor-Arrays-BCD.jl",
        "MIT",
        "eight chips at rest",
    ),
    Source(
        "still_mpu6050_10min", "github.com/sunsided/sensor-fusion", "EUPL-1.2", "a chip at rest"
    ),
    Source(
        "uwb_errors_outdoor",
        "github.com/cucudasluv/UWB-dataset",
        "Apache-2.0",
        "ranges and true distances outdoors",
    ),
    Source(
        "uwb_errors_university",
        "github.com/JaronFontaine/UWB-dataset-from-an-office-industrial-and-university-environment",
        "none stated",
        "ranges and true distances in rooms and through walls",
    ),
)
