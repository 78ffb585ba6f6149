/* SPDX-FileCopyrightText: RISE-DI contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * A double that counts its operations: in front of proof.c, compiled as C++.
 */
#ifndef COUNTING
#define COUNTING

#include <algorithm>
#include <cstdint>
#include <cstdio>

namespace counted {
enum { ADD, MULTIPLY, DIVIDE, COMPARE, KINDS };
static long now[KINDS], most[KINDS];

struct real {
    double value;
    real() = default;
    template <typename T> constexpr real(T number) : value(static_cast<double>(number)) {}
    explicit operator double() const { return value; }
    explicit operator int32_t() const { return static_cast<int32_t>(value); }
    real operator-() const { return real(-value); }
};
static inline real operator+(real a, real b) { now[ADD]++; return real(a.value + b.value); }
static inline real operator-(real a, real b) { now[ADD]++; return real(a.value - b.value); }
static inline real operator*(real a, real b) { now[MULTIPLY]++; return real(a.value * b.value); }
static inline real operator/(real a, real b) { now[DIVIDE]++; return real(a.value / b.value); }
static inline bool operator<(real a, real b) { now[COMPARE]++; return a.value < b.value; }
static inline bool operator>(real a, real b) { now[COMPARE]++; return a.value > b.value; }
static inline bool operator<=(real a, real b) { now[COMPARE]++; return a.value <= b.value; }
static inline bool operator>=(real a, real b) { now[COMPARE]++; return a.value >= b.value; }
static inline bool operator==(real a, real b) { now[COMPARE]++; return a.value == b.value; }
static inline bool operator!=(real a, real b) { now[COMPARE]++; return a.value != b.value; }
} // namespace counted

static void begin_count() { std::fill(counted::now, counted::now + counted::KINDS, 0L); }
static void end_count() {
    for (int i = 0; i < counted::KINDS; i++) {
        counted::most[i] = std::max(counted::most[i], counted::now[i]);
    }
}
static void print_count() {
    std::printf(", \"add\": %ld, \"multiply\": %ld, \"divide\": %ld, \"compare\": %ld", counted::most[counted::ADD],
                counted::most[counted::MULTIPLY], counted::most[counted::DIVIDE], counted::most[counted::COMPARE]);
}

#define RISE_DI_REAL
using rise_di_real = counted::real;
#endif
