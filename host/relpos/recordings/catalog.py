"""The public sources of the recordings that the published figures rest on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from relpos.recordings import (
    back,
    chest,
    daily,
    four_robots,
    hamburg,
    handheld,
    lowerback,
    mocap,
    museum,
    phone_strides,
    ranges,
    still,
    treadmill,
    two_robots,
)
from relpos.recordings.tables import Archive, ConvertedRun

Convert = Callable[[Archive], Iterator[ConvertedRun]]


@dataclass(frozen=True)
class Source:
    """One set: its repository at a commit, and what `get` makes of it.

    ``sha256`` is that of all converted tables (`tables.digest`).
    """

    name: str
    repository: str
    licence: str
    holds: str
    commit: str
    convert: Convert
    sha256: str = ""

    @property
    def address(self) -> str:
        """What is downloaded."""
        return f"https://{self.repository}/archive/{self.commit}.zip"


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
        "34aa8aebe62649609679bb450996b8427e3638e6",
        daily.convert,
        "7e2eb993d1a09666f2a7a8b3f422009a2817485489452251742b491f27233ce5",
    ),
    Source(
        "walk_chest",
        "github.com/eternalamit5/"
        "An-improved-wearable-multi-sensor-fusion-Pedestrian-Dead-Reckoning-system"
        "-for-indoor-localisation",
        "MIT",
        "chest, one corridor both ways",
        "aeefcea257df5357807e58f0efd8198d212903d0",
        chest.convert,
        "3d4cc710121ebb1f77e9fa29232e2e0c09f16ca8c3ad294d292378e4ff7137fd",
    ),
    Source(
        "walk_treadmill_stroke_lumbar",
        "github.com/SintMaartenskliniek/MovingReality",
        "MIT",
        "lower back on a treadmill, after a stroke",
        "a7d943f567705d06fce4229d9a24207f55a2b177",
        treadmill.convert,
        "ad612af050c995b37ecc07bd381f195f5c59cd3ba9a36a323a5df9fba3ea1738",
    ),
    Source(
        "walk_5m_back",
        "github.com/Marpino/Walking-dataset",
        "none stated",
        "back, 5 m, elderly and young",
        "4458e4a9928c7e17a824de0727b822f02e095817",
        back.people,
        "6737f810419453a4af67993c30df75e252fdf7ff1210710bcf4820391476b1a2",
    ),
    Source(
        "walk_author_back",
        "github.com/Marpino/Walking-dataset",
        "none stated",
        "back, lines and loops",
        "4458e4a9928c7e17a824de0727b822f02e095817",
        back.author,
        "129393abd01d0037cd03b7cd1a3129c89b8c0e874bde56eb195f06934fb19859",
    ),
    Source(
        "walk_mocap_virtual",
        "github.com/NikonPic/imu_gait_analysis",
        "none stated",
        "motion capture, virtual IMU: level",
        "3eb8c391097c4ae9147d234b376fe3bba2b82109",
        mocap.walks,
        "a47b9c3fbf9ec1eef15efee454f56ab2912c30dc1af98c40f5d6ac47b0a8145f",
    ),
    Source(
        "stairs_mocap_virtual",
        "github.com/NikonPic/imu_gait_analysis",
        "none stated",
        "motion capture, virtual IMU: stairs",
        "3eb8c391097c4ae9147d234b376fe3bba2b82109",
        mocap.stairs,
        "ea884004eb9784eddd8ea690bc1316f6d44aa59a0cc32b737e6fcc6f7731dc83",
    ),
    Source(
        "walk_phone_strides",
        "github.com/Archeries/StrideLengthEstimation",
        "none stated",
        "phone before the chest, every stride",
        "c96f67c79a81a8f2098eee051dd41c0c1ba1d102",
        phone_strides.convert,
        "b458981d6944bfb308b3b17c79aa7dff3b19233a296e0c9db2c691fef7bf4101",
    ),
    Source(
        "walk_phone_museum",
        "github.com/Kenny5269/2023_IPIN_Competition_Track03",
        "see zenodo.org/records/8362205",
        "phone in the hand, surveyed points (IPIN 2023 track 3)",
        "da1b24b67f48a48a5e69ef35c1fd33d3f03b1592",
        museum.convert,
        "61e0af4fbc776ef5549b94204021273aaead34dc9d10e078b4d6ddc2b09c56a9",
    ),
    Source(
        "height_phone_museum",
        "github.com/Kenny5269/2023_IPIN_Competition_Track03",
        "see zenodo.org/records/8362205",
        "phone in the hand, pressure, floors of surveyed points (IPIN 2023 track 3)",
        "da1b24b67f48a48a5e69ef35c1fd33d3f03b1592",
        museum.heights,
        "e979ff98eb96114f03e7004dc99b54574c0ec66d7ea8ee3e81a6d8d7d62be391",
    ),
    Source(
        "height_phone_hamburg",
        "github.com/Hossein-Shoushtari/IPIN21Data",
        "none stated",
        "phone before the chest, pressure, heights of points on three floors",
        "715aee024e994289c3465e0ceb30777a31080cff",
        hamburg.convert,
        "d91eb84cbf91f7389ef601603a6efe25307537c076de3abf455de9f8b1f45392",
    ),
    Source(
        "still_mpu9150_8chips",
        "github.com/hcarlsso/Self-Calibration-Inertial-Sensor-Arrays-BCD.jl",
        "MIT",
        "eight chips at rest",
        "2f2a8b179882f05b2343e1be6e861af50d583b3d",
        still.chips,
        "efe0666a073a0149f70576ecdc95744139a63464f7236f61fa75869501635960",
    ),
    Source(
        "still_mpu6050_10min",
        "github.com/sunsided/sensor-fusion",
        "EUPL-1.2",
        "a chip at rest",
        "f16045a9d1d4f9037a183f436fe3c098a38ad99d",
        still.ten_minutes,
        "f6fc5b3c8f3e4104ac8ae09837a14d8b74ae253962da8852d7b608d6d16609c7",
    ),
    Source(
        "uwb_errors_outdoor",
        "github.com/cucudasluv/UWB-dataset",
        "Apache-2.0",
        "ranges and true distances outdoors",
        "c12599812e556324eadc763e409ea8f51098dda6",
        ranges.outdoor,
        "fc06757ee933c0f5650f0900b149d4b1f9e6e733b089590254d83c64b03cee1b",
    ),
    Source(
        "uwb_errors_university",
        "github.com/JaronFontaine/UWB-dataset-from-an-office-industrial-and-university-environment",
        "none stated",
        "ranges and true distances in rooms and through walls",
        "f5b270d12d7129a95426e0f738b28449fa3cb6c1",
        ranges.university,
        "d4f9ef334fcefd7d9bdf9842ed850cda2beb6305342580b15e1fe21fc807fcf9",
    ),
    Source(
        "two_robots_vio",
        "github.com/y2d2/UPF_RPE",
        "GPL-3.0",
        "two robots, visual-inertial odometry and UWB, Vicon",
        "1ba55b0c427d8d42afdb65299104711eae815251",
        two_robots.convert,
        "d020c4d4f34ed3852846d0a8cb2a8a4da60626b8bded1d50c89f24e36428f895",
    ),
    Source(
        "four_robots_uwb",
        "github.com/TIERS/uwb-cooperative-mrs-localization",
        "MIT",
        "four robots, six UWB links, OptiTrack; motion synthesised",
        "06897d1008463a0c7eb8f499d358298fee8f53ad",
        four_robots.convert,
        "e38cd514f9a3b9da1cbfddc818843bfe9068913b63aea0d055925ee1687840ab",
    ),
)
