// What the suites take for granted of the compiler, and that the framework compares what it says.
#include "support/check.h"

TEST(fixed_width_types_are_as_wide_as_they_say) {
    CHECK_EQUAL(2, sizeof(int16_t));
    CHECK_EQUAL(4, sizeof(int32_t));
    CHECK_EQUAL(8, sizeof(int64_t));
    CHECK_EQUAL(4, sizeof(float));
}

TEST(integers_are_compared_over_the_whole_range) {
    CHECK_EQUAL(INT32_MIN, -2147483647L - 1);
    CHECK_EQUAL(UINT32_MAX, 4294967295UL);
    CHECK(!(static_cast<uint32_t>(0) - 1 < 4294967295UL));
}

TEST(a_float_loop_of_a_filter_s_shape_gives_the_sum_it_should) {
    // The shape that avr-gcc 5.4 miscompiles at -Os without -fno-ivopts: F P F' in place.
    volatile float scale = 0.5f;
    float covariance[4][4];
    float transition[4][4];
    for (uint8_t row = 0; row < 4; ++row) {
        for (uint8_t column = 0; column < 4; ++column) {
            covariance[row][column] = row == column ? 1.0f : 0.0f;
            transition[row][column] = row == column ? 1.0f : (column == row + 1 ? scale : 0.0f);
        }
    }
    float product[4][4];
    for (uint8_t row = 0; row < 4; ++row) {
        for (uint8_t column = 0; column < 4; ++column) {
            float sum = 0;
            for (uint8_t i = 0; i < 4; ++i) {
                for (uint8_t j = 0; j < 4; ++j) {
                    sum += transition[row][i] * covariance[i][j] * transition[column][j];
                }
            }
            product[row][column] = sum;
        }
    }
    CHECK_NEAR(1.25f, product[0][0], 1e-6f);
    CHECK_NEAR(0.5f, product[0][1], 1e-6f);
    CHECK_NEAR(0.0f, product[0][2], 1e-6f);
    CHECK_NEAR(1.0f, product[3][3], 1e-6f);
}

TEST(equal_bytes_are_equal) {
    const uint8_t left[] = {1, 2, 255};
    const uint8_t right[] = {1, 2, 255};
    CHECK_BYTES(left, right, 3);
}

RUN_TESTS()
