// Which sensor the firmware is built for: -DRELPOS_IMU=MPU9250 for one of the MPU-9150's successors
// MPU-9250 and MPU-9255. They have a filter of the accelerometer's own and the compass AK8963.
#pragma once

#define MPU9150 1
#define MPU9250 2
#ifndef RELPOS_IMU
#define RELPOS_IMU MPU9150
#endif
#if RELPOS_IMU != MPU9150 && RELPOS_IMU != MPU9250
#error "RELPOS_IMU is MPU9150 or MPU9250"
#endif

namespace relpos {

constexpr bool kSuccessor = RELPOS_IMU == MPU9250;

}  // namespace relpos
