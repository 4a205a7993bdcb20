// A test framework of one header that prints Unity's lines, so that one suite runs on this computer
// and on the AVR, where every string stays in flash. How to add a suite: CONTRIBUTING.md.
#pragma once

#include <math.h>
#include <stdint.h>
#include <string.h>

#if defined(__AVR__)
#include <avr/interrupt.h>
#include <avr/pgmspace.h>
#include <avr/sleep.h>
#else
#include <stdio.h>
#define PSTR(text) (text)
#endif

namespace check {

#if defined(__AVR__)
inline void open_output() {
    UCSR0A = _BV(U2X0);
    UBRR0 = F_CPU / 8 / 115200 - 1;
    UCSR0B = _BV(TXEN0);
}
inline void put(char character) {
    while (!(UCSR0A & _BV(UDRE0))) {
    }
    UDR0 = character;
}
inline char text_at(const char* text) { return static_cast<char>(pgm_read_byte(text)); }
// Sleeping with interrupts off ends simavr.
inline int close_output(int) {
    for (uint32_t wait = 0; wait < F_CPU / 1000; ++wait) {
        __asm__ __volatile__("nop");
    }
    cli();
    sleep_enable();
    for (;;) {
        sleep_cpu();
    }
}
#else
inline void open_output() { setvbuf(stdout, nullptr, _IOLBF, 1024); }
inline void put(char character) { putchar(character); }
inline char text_at(const char* text) { return *text; }
inline int close_output(int failures) { return failures > 0 ? 1 : 0; }
#endif

inline void print(const char* text_in_flash) {
    while (char character = text_at(text_in_flash++)) {
        put(character);
    }
}

inline void print_integer(int64_t value) {
    char digits[20];
    uint8_t count = 0;
    uint64_t rest = value < 0 ? -static_cast<uint64_t>(value) : static_cast<uint64_t>(value);
    do {
        digits[count++] = static_cast<char>('0' + rest % 10);
        rest /= 10;
    } while (rest != 0);
    if (value < 0) {
        put('-');
    }
    while (count > 0) {
        put(digits[--count]);
    }
}

// Seven significant digits as m.mmmmmme+xx; printf's float support is not linked on the AVR.
inline void print_float(float value) {
    if (isnan(value)) {
        print(PSTR("nan"));
        return;
    }
    if (value < 0) {
        put('-');
        value = -value;
    }
    if (isinf(value)) {
        print(PSTR("inf"));
        return;
    }
    int exponent = 0;
    while (value >= 10.0f) {
        value /= 10.0f;
        ++exponent;
    }
    while (value > 0 && value < 1.0f) {
        value *= 10.0f;
        --exponent;
    }
    int32_t digits = static_cast<int32_t>(value * 1e6f + 0.5f);
    print_integer(digits / 1000000);
    put('.');
    int32_t rest = digits % 1000000;
    for (int32_t place = 100000; place > 0; place /= 10) {
        put(static_cast<char>('0' + rest / place % 10));
    }
    put('e');
    print_integer(exponent);
}

struct Test {
    const char* file;
    const char* name;
    int line;
    void (*body)();
    Test* next;

    static Test*& first() {
        static Test* head = nullptr;
        return head;
    }
    static bool& failed() {
        static bool flag = false;
        return flag;
    }
    static Test*& current() {
        static Test* test = nullptr;
        return test;
    }

    Test(const char* in_file, const char* with_name, int at_line, void (*with_body)())
        : file(in_file), name(with_name), line(at_line), body(with_body), next(nullptr) {
        Test** end = &first();
        while (*end != nullptr) {
            end = &(*end)->next;
        }
        *end = this;
    }
};

inline void print_place(int line) {
    print(Test::current()->file);
    put(':');
    print_integer(line);
    put(':');
    print(Test::current()->name);
}

// Prints the beginning of a failure; what it says of the values follows, then a new line.
inline void begin_failure(int line) {
    Test::failed() = true;
    print_place(line);
    print(PSTR(":FAIL: "));
}

inline bool is_true(bool value, const char* expression, int line) {
    if (!value) {
        begin_failure(line);
        print(expression);
        put('\n');
    }
    return value;
}

inline bool are_equal(int64_t expected, int64_t actual, const char* expression, int line) {
    if (expected == actual) {
        return true;
    }
    begin_failure(line);
    print(expression);
    print(PSTR(" is "));
    print_integer(actual);
    print(PSTR(", expected "));
    print_integer(expected);
    put('\n');
    return false;
}

inline bool are_near(float expected, float actual, float tolerance, const char* expression,
                     int line) {
    if (fabsf(expected - actual) <= tolerance) {  // false for NaN
        return true;
    }
    begin_failure(line);
    print(expression);
    print(PSTR(" is "));
    print_float(actual);
    print(PSTR(", expected "));
    print_float(expected);
    print(PSTR(" within "));
    print_float(tolerance);
    put('\n');
    return false;
}

inline bool are_equal_bytes(const void* expected, const void* actual, uint16_t count,
                            const char* expression, int line) {
    const uint8_t* left = static_cast<const uint8_t*>(expected);
    const uint8_t* right = static_cast<const uint8_t*>(actual);
    for (uint16_t i = 0; i < count; ++i) {
        if (left[i] != right[i]) {
            begin_failure(line);
            print(expression);
            print(PSTR(" byte "));
            print_integer(i);
            print(PSTR(" is "));
            print_integer(right[i]);
            print(PSTR(", expected "));
            print_integer(left[i]);
            put('\n');
            return false;
        }
    }
    return true;
}

inline int run_all() {
    open_output();
    int tests = 0;
    int failures = 0;
    for (Test* test = Test::first(); test != nullptr; test = test->next) {
        Test::current() = test;
        Test::failed() = false;
        test->body();
        ++tests;
        if (Test::failed()) {
            ++failures;
        } else {
            print_place(test->line);
            print(PSTR(":PASS\n"));
        }
    }
    print_integer(tests);
    print(PSTR(" Tests "));
    print_integer(failures);
    print(PSTR(" Failures 0 Ignored\n"));
    return close_output(failures);
}

}  // namespace check

#if defined(__AVR__)
#define CHECK_IN_FLASH PROGMEM
#else
#define CHECK_IN_FLASH
#endif

// A test, named as the sentence that is false when it fails: TEST(a_lost_frame_loses_no_motion) { }
#define TEST(sentence)                                                                       \
    static void sentence();                                                                  \
    static const char sentence##_file[] CHECK_IN_FLASH = __FILE__;                           \
    static const char sentence##_name[] CHECK_IN_FLASH = #sentence;                          \
    static check::Test sentence##_test(sentence##_file, sentence##_name, __LINE__, sentence); \
    static void sentence()

// The first check that fails ends the function it stands in.
#define CHECK(condition)                                               \
    do {                                                               \
        if (!check::is_true((condition), PSTR(#condition), __LINE__)) { \
            return;                                                    \
        }                                                              \
    } while (0)
// Integers and enumerations.
#define CHECK_EQUAL(expected, actual)                                                          \
    do {                                                                                       \
        if (!check::are_equal(static_cast<int64_t>(expected), static_cast<int64_t>(actual),    \
                              PSTR(#actual), __LINE__)) {                                      \
            return;                                                                            \
        }                                                                                      \
    } while (0)
#define CHECK_NEAR(expected, actual, tolerance)                                                 \
    do {                                                                                        \
        if (!check::are_near((expected), (actual), (tolerance), PSTR(#actual), __LINE__)) {     \
            return;                                                                             \
        }                                                                                       \
    } while (0)
#define CHECK_BYTES(expected, actual, count)                                                     \
    do {                                                                                         \
        if (!check::are_equal_bytes((expected), (actual), (count), PSTR(#actual), __LINE__)) {   \
            return;                                                                              \
        }                                                                                        \
    } while (0)

// Once in every suite, after its tests.
#define RUN_TESTS() \
    int main() { return check::run_all(); }
