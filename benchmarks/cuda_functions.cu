// How far from the exact result are the float32 functions that gsplat's kernels use, on this device?
//
//     nvcc -O3 --use_fast_math -std=c++17 -arch=sm_90 -o cuda_functions cuda_functions.cu
//     g++ -x c++ -DHOST -O2 -std=c++17 -o cuda_functions cuda_functions.cu
//     ./cuda_functions [NAME=NUMBER ...]
//
// One-argument functions are called with every bit pattern. gsplat is compiled with --use_fast_math, and so is this.
// Without a device (-DHOST) the C library's functions stand in, with subnormals flushed: that tests the comparison.
//
// Exact results come from double arithmetic: CUDA's double exp and log err by 1 ulp, its division and root by half of
// one, that is 2^-28 of what is measured here.
//
// Prints one JSON object per line: one for the device, one per range of a function. `cuda_functions.py` makes a table
// of them, and holds the charges that arrive here as arguments. Progress goes to stderr.

#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <map>
#include <string>
#include <vector>

#ifdef HOST
#if defined(__SSE2__)
#include <xmmintrin.h>
#endif
#define HD inline
#define __global__
#else
#define HD __host__ __device__ inline
#endif

// --- Numbers ---------------------------------------------------------------------------------------------------------

constexpr double UNIT = 0x1p-24;
constexpr double TINY = 0x1p-126;
constexpr double HUGE_FLOAT = 0x1.fffffep127;
// Results this near to the least normal number may round below it and are then flushed.
constexpr double FLUSHED = TINY * (1.0 + 0x1p-15);
constexpr double FLUSH_ROOM = 1.0 + 0x1p-10;
constexpr double NOT_CHARGED = -1.0;

template <class To, class From> HD To bits_as(From from) {
    static_assert(sizeof(To) == sizeof(From), "sizes differ");
    To to;
    memcpy(&to, &from, sizeof(to));
    return to;
}

HD float as_float(uint32_t bits) { return bits_as<float>(bits); }

// splitmix64
HD uint64_t random_bits(uint64_t index) {
    uint64_t z = (index + 1) * 0x9e3779b97f4a7c15ull;
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ull;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebull;
    return z ^ (z >> 31);
}

// Of a float32 of this size.
HD double ulp(double exact) {
    int exponent = static_cast<int>((bits_as<uint64_t>(exact) >> 52) & 0x7ff) - 1023;
    if (exponent < -126) exponent = -126;
    return bits_as<double>(static_cast<uint64_t>(exponent - 23 + 1023) << 52);
}

// Bits decide: under --use_fast_math a comparison takes a subnormal for 0.
HD bool is_subnormal(float x) {
    const uint32_t bits = bits_as<uint32_t>(x) & 0x7fffffffu;
    return bits != 0 && bits < 0x00800000u;
}

HD bool is_finite(float x) { return (bits_as<uint32_t>(x) & 0x7f800000u) != 0x7f800000u; }

// Exact also for subnormals, which a conversion under --use_fast_math flushes.
HD double exact_double(float x) {
    const uint32_t bits = bits_as<uint32_t>(x);
    if (!is_subnormal(x)) return static_cast<double>(x);
    const double size = static_cast<double>(bits & 0x7fffffu) * 0x1p-149;
    return bits >> 31 ? -size : size;
}

// --- The functions under test, written as gsplat writes them --------------------------------------------------------

#ifdef __CUDA_ARCH__
__device__ inline float tested_exp(float x) { return __expf(x); }
__device__ inline float tested_log(float x) { return __logf(x); }
__device__ inline float tested_sqrt(float x) { return sqrtf(x); }
__device__ inline float tested_rsqrt(float x) { return rsqrtf(x); }
#else
HD float tested_exp(float x) { return static_cast<float>(std::exp(static_cast<double>(x))); }
HD float tested_log(float x) { return static_cast<float>(std::log(static_cast<double>(x))); }
HD float tested_sqrt(float x) { return std::sqrt(x); }
HD float tested_rsqrt(float x) { return static_cast<float>(1.0 / std::sqrt(static_cast<double>(x))); }
#endif
HD float tested_reciprocal(float x) { return 1.f / x; }
HD float tested_division(float a, float b) { return a / b; }

// quat_to_rotmat of gsplat's utils.cuh, by rows
HD void tested_rotation(float w, float x, float y, float z, float *r) {
    const float inv_norm = tested_rsqrt(x * x + y * y + z * z + w * w);
    x *= inv_norm;
    y *= inv_norm;
    z *= inv_norm;
    w *= inv_norm;
    const float x2 = x * x, y2 = y * y, z2 = z * z;
    const float xy = x * y, xz = x * z, yz = y * z;
    const float wx = w * x, wy = w * y, wz = w * z;
    r[0] = 1.f - 2.f * (y2 + z2), r[1] = 2.f * (xy - wz), r[2] = 2.f * (xz + wy);
    r[3] = 2.f * (xy + wz), r[4] = 1.f - 2.f * (x2 + z2), r[5] = 2.f * (yz - wx);
    r[6] = 2.f * (xz - wy), r[7] = 2.f * (yz + wx), r[8] = 1.f - 2.f * (x2 + y2);
}

// --- What is recorded ------------------------------------------------------------------------------------------------

// What is no number is larger than any.
HD bool larger_than(double x, double before) { return before == before && !(x <= before); }

// Of one range of one function: the largest error in ulps, in units, and as a share of its charge.
struct Record {
    double ulps = 0, units = 0, share = 0, charge = NOT_CHARGED;
    uint64_t at_units = 0, at_share = 0, count = 0;

    HD void add(uint64_t index, double error, double unit, double one_ulp, double charged) {
        ++count;
        if (one_ulp > 0 && larger_than(error / one_ulp, ulps)) ulps = error / one_ulp;
        if (larger_than(error / unit, units)) units = error / unit, at_units = index;
        if (charged < 0) return;
        const double found = error == 0 ? 0 : error / unit / charged;
        if (charge < 0 || larger_than(found, share)) share = found, at_share = index, charge = charged;
    }

    HD void merge(const Record &other) {
        count += other.count;
        if (larger_than(other.ulps, ulps)) ulps = other.ulps;
        if (larger_than(other.units, units)) units = other.units, at_units = other.at_units;
        if (other.charge >= 0 && (charge < 0 || larger_than(other.share, share)))
            share = other.share, at_share = other.at_share, charge = other.charge;
    }
};

// In units; those of a programming guide's ulps are twice as many.
struct Charges {
    double exp, exp_slope, log_absolute, log_ulps, sqrt, rsqrt, division, flush, rotation, direction;
    // least |q|^2 that a scene may hold
    double least_squared;
    // compare sums and products with what truncation gives: has to fail
    bool truncated;
};

struct Range {
    const char *name, *unit;
};

// Index to bit pattern: the index itself, or one of each of `inputs` equal parts.
struct Patterns {
    uint64_t inputs;
    HD uint32_t operator()(uint64_t index) const {
        if (inputs >= 1ull << 32) return static_cast<uint32_t>(index);
        const double width = 4294967296.0 / static_cast<double>(inputs);
        const double place = static_cast<double>(random_bits(index) >> 11) * 0x1p-53;
        return static_cast<uint32_t>((static_cast<double>(index) + place) * width);
    }
};

// Numbers as a row of the table has them.
std::string listed(const float *values, int count) {
    std::string found;
    for (int k = 0; k < count; ++k) {
        char text[32];
        snprintf(text, sizeof(text), "%.9g", exact_double(values[k]));
        found += (k ? ", " : "") + std::string(text);
    }
    return found;
}

template <class F> std::string one_argument(const F &f, uint64_t index) {
    const float x = as_float(f.patterns(index));
    return listed(&x, 1);
}

// --- One function each -----------------------------------------------------------------------------------------------
// `RANGES` and, by index, calls of emit(range, error, unit, ulp, charge in units)

struct Exponential {
    static constexpr const char *NAME = "__expf(x)";
    static constexpr int RANGES = 6;
    static const Range *ranges() {
        static const Range all[] = {
            {"-5.55 <= x <= 0 (alpha reaches 1/255)", "2^-24"}, {"-60 <= x < -5.55", "2^-24"},
            {"x < -60, result normal", "2^-24"}, {"x > 0, result finite", "2^-24"},
            {"result below 2^-126", "2^-126"}, {"result overflows", "2^-24"}};
        return all;
    }
    Patterns patterns;
    Charges c;
    std::string at(uint64_t index) const { return one_argument(*this, index); }
    template <class E> HD void operator()(uint64_t index, E emit) const {
        const float x = as_float(patterns(index));
        if (!is_finite(x)) return;
        const double wide = exact_double(x), exact = ::exp(wide), error = fabs(exact_double(tested_exp(x)) - exact);
        const double charge = c.exp + c.exp_slope * fabs(wide);
        if (exact < FLUSHED) return emit(4, error, TINY, 0.0, c.flush * FLUSH_ROOM);
        if (exact > HUGE_FLOAT * (1.0 - 0x1p-12)) return emit(5, error, exact * UNIT, 0.0, NOT_CHARGED);
        const int range = wide > 0 ? 3 : wide >= -5.55 ? 0 : wide >= -60 ? 1 : 2;
        emit(range, error, exact * UNIT, ulp(exact), charge);
    }
};

struct Logarithm {
    static constexpr const char *NAME = "__logf(x)";
    static constexpr int RANGES = 6;
    static const Range *ranges() {
        static const Range all[] = {
            {"1 <= x <= 2", "2^-24 (absolute)"}, {"2 < x <= 256 (opacity over 1/255)", "ulp"},
            {"0.5 <= x < 1", "2^-24 (absolute)"}, {"x < 0.5, normal", "ulp"}, {"x > 256", "ulp"},
            {"x subnormal", "ulp"}};
        return all;
    }
    Patterns patterns;
    Charges c;
    std::string at(uint64_t index) const { return one_argument(*this, index); }
    template <class E> HD void operator()(uint64_t index, E emit) const {
        const float x = as_float(patterns(index));
        const double wide = exact_double(x);
        if (!is_finite(x) || wide <= 0) return;
        const double exact = ::log(wide), error = fabs(exact_double(tested_log(x)) - exact);
        if (wide >= 0.5 && wide <= 2.0) return emit(wide < 1.0 ? 2 : 0, error, UNIT, 0.0, c.log_absolute);
        const int range = wide > 256.0 ? 4 : wide > 2.0 ? 1 : is_subnormal(x) ? 5 : 3;
        // gsplat takes logarithms of what is at least 1, but for rounding
        emit(range, error, ulp(exact), ulp(exact), range == 3 || range == 5 ? NOT_CHARGED : c.log_ulps);
    }
};

struct SquareRoot {
    static constexpr const char *NAME = "sqrtf(x)";
    static HD float tested(float x) { return tested_sqrt(x); }
    static HD double exact(double x) { return ::sqrt(x); }
    static HD double charge(const Charges &c) { return c.sqrt; }
};

struct ReciprocalRoot {
    static constexpr const char *NAME = "rsqrtf(x)";
    static HD float tested(float x) { return tested_rsqrt(x); }
    static HD double exact(double x) { return 1.0 / ::sqrt(x); }
    static HD double charge(const Charges &c) { return c.rsqrt; }
};

template <class F> struct Rooted {
    static constexpr const char *NAME = F::NAME;
    static constexpr int RANGES = 2;
    static const Range *ranges() {
        static const Range all[] = {{"x normal", "2^-24"}, {"x subnormal", "2^-24"}};
        return all;
    }
    Patterns patterns;
    Charges c;
    std::string at(uint64_t index) const { return one_argument(*this, index); }
    template <class E> HD void operator()(uint64_t index, E emit) const {
        const float x = as_float(patterns(index));
        const double wide = exact_double(x);
        if (!is_finite(x) || wide <= 0) return;
        const double exact = F::exact(wide), error = fabs(exact_double(F::tested(x)) - exact);
        const bool small = is_subnormal(x);
        emit(small ? 1 : 0, error, exact * UNIT, ulp(exact), small ? NOT_CHARGED : F::charge(c));
    }
};

struct Reciprocal {
    static constexpr const char *NAME = "1.f / x";
    static constexpr int RANGES = 3;
    static const Range *ranges() {
        static const Range all[] = {
            {"2^-126 <= |x| <= 2^126", "2^-24"}, {"|x| > 2^126", "2^-126"}, {"x subnormal", "2^-24"}};
        return all;
    }
    Patterns patterns;
    Charges c;
    std::string at(uint64_t index) const { return one_argument(*this, index); }
    template <class E> HD void operator()(uint64_t index, E emit) const {
        const float x = as_float(patterns(index));
        const double wide = exact_double(x);
        if (!is_finite(x) || wide == 0) return;
        const double exact = 1.0 / wide, error = fabs(exact_double(tested_reciprocal(x)) - exact);
        if (fabs(wide) > 0x1p126) return emit(1, error, TINY, 0.0, c.flush * FLUSH_ROOM);
        const bool small = is_subnormal(x);
        emit(small ? 2 : 0, error, fabs(exact) * UNIT, ulp(exact), small ? NOT_CHARGED : c.division);
    }
};

// Exponents moderate and arbitrary by turns.
HD void random_pair(uint64_t index, float &a, float &b) {
    const uint64_t bits = random_bits(index);
    uint32_t first = static_cast<uint32_t>(bits), second = static_cast<uint32_t>(bits >> 32);
    if (index & 1) {
        first = (first & 0x807fffffu) | (111 + ((first >> 23) & 31)) << 23;
        second = (second & 0x807fffffu) | (111 + ((second >> 23) & 31)) << 23;
    }
    a = as_float(first), b = as_float(second);
}

struct Quotient {
    static constexpr const char *NAME = "a / b, random";
    static constexpr int RANGES = 6;
    static const Range *ranges() {
        static const Range all[] = {
            {"moderate exponents (16 binades about 1)", "2^-24"},
            {"2^-126 <= |b| <= 2^126, result normal", "2^-24"},
            {"|b| <= 2^126, result below 2^-126", "2^-126"},
            {"|b| > 2^126, result normal", "2^-24"},
            {"result overflows", "2^-24"}, {"a or b subnormal", "2^-24"}};
        return all;
    }
    Charges c;
    std::string at(uint64_t index) const {
        float a, b;
        random_pair(index, a, b);
        char text[96];
        snprintf(text, sizeof(text), "%.9g / %.9g", exact_double(a), exact_double(b));
        return text;
    }
    template <class E> HD void operator()(uint64_t index, E emit) const {
        float a, b;
        random_pair(index, a, b);
        const double x = exact_double(a), y = exact_double(b);
        if (!is_finite(a) || !is_finite(b) || x == 0 || y == 0) return;
        const double exact = x / y, size = fabs(exact), error = fabs(exact_double(tested_division(a, b)) - exact);
        if (is_subnormal(a) || is_subnormal(b)) return emit(5, error, size * UNIT, 0.0, NOT_CHARGED);
        if (size > HUGE_FLOAT * (1.0 - 0x1p-20)) return emit(4, error, size * UNIT, 0.0, NOT_CHARGED);
        if (size < FLUSHED) return emit(2, error, TINY, 0.0, c.flush * FLUSH_ROOM);
        if (fabs(y) > 0x1p126) return emit(3, error, size * UNIT, 0.0, NOT_CHARGED);
        emit(index & 1 ? 0 : 1, error, size * UNIT, ulp(exact), c.division);
    }
};

// Every mantissa, once each.
HD float numerator(uint32_t place) { return as_float(0x3f800000u | ((place * 5184353u) & 0x7fffffu)); }

// One numerator over every mantissa of the denominator: finds where the largest error is.
struct QuotientsOf {
    static constexpr int RANGES = 1;
    float a;
    double charge;
    template <class E> HD void operator()(uint64_t index, E emit) const {
        const float b = as_float(0x3f800000u | static_cast<uint32_t>(index));
        const double exact = static_cast<double>(a) / static_cast<double>(b);
        emit(0, fabs(static_cast<double>(tested_division(a, b)) - exact), exact * UNIT, ulp(exact), charge);
    }
};

// The double nearest to x + y on the side of odd mantissas: rounded once more, to float32, it is as if rounded once.
HD double odd_sum(double x, double y) {
    const double sum = x + y, part = sum - x;
    const double error = (x - (sum - part)) + (y - part);
    uint64_t bits = bits_as<uint64_t>(sum);
    // overflow and no number
    if (!(fabs(sum) <= 0x1p1000)) return sum;
    if (error != 0 && !(bits & 1)) bits += (error > 0) == (sum > 0) ? 1 : -1;
    return bits_as<double>(bits);
}

struct Sums {
    static constexpr const char *NAME = "IEEE rounding";
    static constexpr int RANGES = 5;
    static const Range *ranges() {
        static const Range all[] = {{"a + b", "ulp"}, {"a - b", "ulp"}, {"a * b", "ulp"}, {"fma(a, b, c)", "ulp"},
                                    {"results below 2^-126", "2^-126"}};
        return all;
    }
    Charges c;

    static HD void draw(uint64_t index, float &a, float &b, float &other) {
        const uint64_t bits = random_bits(2 * index), more = random_bits(2 * index + 1);
        uint32_t first = static_cast<uint32_t>(bits), second = static_cast<uint32_t>(bits >> 32);
        uint32_t third = static_cast<uint32_t>(more);
        if (index & 3) {
            // sums in which both terms have a say
            const uint32_t e = 97 + (static_cast<uint32_t>(more >> 32) & 31), f = 112 + ((second >> 23) & 31);
            first = (first & 0x807fffffu) | e << 23;
            second = (second & 0x807fffffu) | f << 23;
            third = (third & 0x807fffffu) | (e + f - 127 - 26 + ((third >> 23) & 63) % 53) << 23;
        }
        a = as_float(first), b = as_float(second), other = as_float(third);
    }
    std::string at(uint64_t index) const {
        float drawn[3];
        draw(index, drawn[0], drawn[1], drawn[2]);
        return listed(drawn, 3);
    }
    template <class E> HD void compare(int range, double odd, float got, E emit) const {
        const bool tiny = fabs(odd) < TINY;
        // a result that is flushed, or rounds to the least normal number
        if (tiny) return emit(4, fabs(exact_double(got) - odd), TINY, 0.0, c.flush * FLUSH_ROOM);
        if (c.truncated) odd = bits_as<double>(bits_as<uint64_t>(odd) >> 29 << 29);
        const float right = static_cast<float>(odd);
        const bool same = bits_as<uint32_t>(right) == bits_as<uint32_t>(got) || (right != right && got != got);
        const double away = fabs(exact_double(right) - exact_double(got));
        emit(range, same ? 0.0 : away, ulp(exact_double(right)), ulp(exact_double(right)), 0.0);
    }
    template <class E> HD void operator()(uint64_t index, E emit) const {
        float a, b, other;
        draw(index, a, b, other);
        if (!is_finite(a) || !is_finite(b) || !is_finite(other)) return;
        // what the device reads of a subnormal
        const double x = is_subnormal(a) ? 0.0 : exact_double(a), y = is_subnormal(b) ? 0.0 : exact_double(b);
        const double z = is_subnormal(other) ? 0.0 : exact_double(other);
        compare(0, odd_sum(x, y), a + b, emit);
        compare(1, odd_sum(x, -y), a - b, emit);
        // 48 bits: exact
        compare(2, x * y, a * b, emit);
        compare(3, odd_sum(x * y, z), fmaf(a, b, other), emit);
    }
};

// A component of a random direction: some are much smaller than others.
HD float component(uint64_t bits, int exponent) {
    const int smaller = bits & 1 ? 0 : static_cast<int>((bits >> 1) & 15);
    const int field = exponent - smaller + 127;
    if (field <= 0) return 0.f;
    return as_float(static_cast<uint32_t>(bits >> 32 & 0x807fffffu) | static_cast<uint32_t>(field) << 23);
}

struct Rotation {
    static constexpr const char *NAME = "quaternion to matrix";
    static constexpr int RANGES = 3;
    static const Range *ranges() {
        static const Range all[] = {{"2^-100 <= |q|^2 < 2^128", "2^-24 (absolute)"},
                                    {"2^-124 <= |q|^2 < 2^-100", "2^-24 (absolute)"},
                                    {"2^-126 <= |q|^2 < 2^-124", "2^-24 (absolute)"}};
        return all;
    }
    Charges c;

    static HD void draw(uint64_t index, float *q) {
        const int exponent = static_cast<int>(random_bits(5 * index) >> 16 & 127) - 64;
        for (int k = 0; k < 4; ++k) q[k] = component(random_bits(5 * index + 1 + k), exponent);
    }
    std::string at(uint64_t index) const {
        float q[4];
        draw(index, q);
        return "(" + listed(q, 4) + ")";
    }
    template <class E> HD void operator()(uint64_t index, E emit) const {
        float q[4], r[9];
        draw(index, q);
        const double squared = static_cast<double>(q[0]) * q[0] + static_cast<double>(q[1]) * q[1] +
                               static_cast<double>(q[2]) * q[2] + static_cast<double>(q[3]) * q[3];
        if (squared < TINY || squared > HUGE_FLOAT * (1.0 - 1e-6)) return;
        tested_rotation(q[0], q[1], q[2], q[3], r);
        const double n = ::sqrt(squared), w = q[0] / n, x = q[1] / n, y = q[2] / n, z = q[3] / n;
        const double exact[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                                 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                                 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)};
        double error = 0;
        for (int k = 0; k < 9; ++k) {
            const double away = fabs(static_cast<double>(r[k]) - exact[k]);
            if (larger_than(away, error)) error = away;
        }
        const int range = squared >= 0x1p-100 ? 0 : squared >= 0x1p-124 ? 1 : 2;
        emit(range, error, UNIT, 0.0, squared >= c.least_squared ? c.rotation : NOT_CHARGED);
    }
};

struct Direction {
    static constexpr const char *NAME = "direction by rsqrtf";
    static constexpr int RANGES = 1;
    static const Range *ranges() {
        static const Range all[] = {{"lengths from 2^-32 to 2^32", "2^-24 (absolute)"}};
        return all;
    }
    Charges c;

    static HD void draw(uint64_t index, float *d) {
        const int exponent = static_cast<int>(random_bits(4 * index) >> 16 & 63) - 32;
        for (int k = 0; k < 3; ++k) d[k] = component(random_bits(4 * index + 1 + k), exponent);
    }
    std::string at(uint64_t index) const {
        float d[3];
        draw(index, d);
        return "(" + listed(d, 3) + ")";
    }
    template <class E> HD void operator()(uint64_t index, E emit) const {
        float d[3];
        draw(index, d);
        // sh_coeffs_to_color_fast
        const float inorm = tested_rsqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
        const double x = d[0], y = d[1], z = d[2], n = ::sqrt(x * x + y * y + z * z);
        const double ex = d[0] * inorm - x / n, ey = d[1] * inorm - y / n, ez = d[2] * inorm - z / n;
        emit(0, ::sqrt(ex * ex + ey * ey + ez * ez), UNIT, 0.0, c.direction);
    }
};

// rasterize_to_pixels_fwd.cu: a Gaussian whose exponent is no number is drawn, with the largest alpha.
struct NoNumber {
    static constexpr const char *NAME = "alpha where sigma is no number";
    static constexpr int RANGES = 1;
    static const Range *ranges() {
        static const Range all[] = {{"0.999, and not skipped", "wrong results"}};
        return all;
    }
    Charges c;
    std::string at(uint64_t) const { return "NaN"; }
    template <class E> HD void operator()(uint64_t index, E emit) const {
        const float sigma = as_float(0x7fc00000u | static_cast<uint32_t>(index));
        // fminf: a NaN gives way, on a host as on the device
        const float alpha = fminf(0.999f, 0.5f * tested_exp(-sigma));
        const bool skipped = sigma < 0.f || alpha < 1.f / 255.f;
        emit(0, skipped || alpha != (c.truncated ? 0.5f : 0.999f) ? 1.0 : 0.0, 1.0, 0.0, 0.0);
    }
};

// --- Running them ----------------------------------------------------------------------------------------------------

using Clock = std::chrono::steady_clock;

double seconds_since(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

#ifdef HOST

template <class F> std::vector<Record> sweep(const F &f, uint64_t inputs) {
    std::vector<Record> records(F::RANGES);
    for (uint64_t index = 0; index < inputs; ++index) {
        f(index, [&](int range, double error, double unit, double one_ulp, double charge) {
            records[range].add(index, error, unit, one_ulp, charge);
        });
    }
    return records;
}

#else

void check(cudaError_t status, const char *what) {
    if (status == cudaSuccess) return;
    fprintf(stderr, "error: %s: %s\n", what, cudaGetErrorString(status));
    exit(3);
}

constexpr int THREADS = 128;

template <class F> __global__ void sweep_kernel(F f, uint64_t inputs, Record *out) {
    Record mine[F::RANGES];
    const uint64_t stride = static_cast<uint64_t>(gridDim.x) * blockDim.x;
    for (uint64_t index = static_cast<uint64_t>(blockIdx.x) * blockDim.x + threadIdx.x; index < inputs;
         index += stride) {
        f(index, [&](int range, double error, double unit, double one_ulp, double charge) {
            mine[range].add(index, error, unit, one_ulp, charge);
        });
    }
    __shared__ alignas(Record) unsigned char storage[THREADS * sizeof(Record)];
    Record *shared = reinterpret_cast<Record *>(storage);
    for (int range = 0; range < F::RANGES; ++range) {
        shared[threadIdx.x] = mine[range];
        __syncthreads();
        for (int half = THREADS / 2; half > 0; half /= 2) {
            if (threadIdx.x < half) shared[threadIdx.x].merge(shared[threadIdx.x + half]);
            __syncthreads();
        }
        if (threadIdx.x == 0) out[blockIdx.x * F::RANGES + range] = shared[0];
        __syncthreads();
    }
}

int multiprocessors = 1;

template <class F> std::vector<Record> sweep(const F &f, uint64_t inputs) {
    const int blocks = multiprocessors * 16;
    std::vector<Record> found(static_cast<size_t>(blocks) * F::RANGES), records(F::RANGES);
    Record *out = nullptr;
    check(cudaMalloc(&out, found.size() * sizeof(Record)), "memory");
    sweep_kernel<<<blocks, THREADS>>>(f, inputs, out);
    check(cudaGetLastError(), "launch");
    check(cudaMemcpy(found.data(), out, found.size() * sizeof(Record), cudaMemcpyDeviceToHost), "kernel");
    check(cudaFree(out), "memory");
    for (size_t k = 0; k < found.size(); ++k) records[k % F::RANGES].merge(found[k]);
    return records;
}

__device__ inline float larger(float x, float y) {
    // fmaxf would lose what is no number
    float out;
    asm("max.NaN.ftz.f32 %0, %1, %2;" : "=f"(out) : "f"(x), "f"(y));
    return out;
}

constexpr int PER_THREAD = 8;

// max over b of |a - (a / b) b| for PER_THREAD numerators a, all of them and b in [1, 2). A residual is a multiple of
// 2^-47 below 2^-20, so the fused operation gives it to a relative 2^-24, if not exactly.
__global__ void residuals(uint32_t first, uint32_t start, uint32_t count, float *worst) {
    const uint32_t threads = gridDim.x * blockDim.x, thread = blockIdx.x * blockDim.x + threadIdx.x;
    float a[PER_THREAD], most[PER_THREAD];
#pragma unroll
    for (int j = 0; j < PER_THREAD; ++j) {
        a[j] = numerator(first + thread + j * threads);
        most[j] = worst[thread + j * threads];
    }
#pragma unroll 4
    for (uint32_t k = start; k < start + count; ++k) {
        const float b = as_float(0x3f800000u | k);
#pragma unroll
        for (int j = 0; j < PER_THREAD; ++j) {
            const float q = tested_division(a[j], b);
            most[j] = larger(most[j], fabsf(fmaf(-q, b, a[j])));
        }
    }
#pragma unroll
    for (int j = 0; j < PER_THREAD; ++j) worst[thread + j * threads] = most[j];
}

#endif

void print_number(const char *name, double value) {
    if (value != value) printf(", \"%s\": NaN", name);
    else if (std::isinf(value)) printf(", \"%s\": Infinity", name);
    else printf(", \"%s\": %.17g", name, value);
}

void print_row(const char *function, const Range &range, const Record &record, const std::string &at_units,
               const std::string &at_share) {
    printf("{\"function\": \"%s\", \"range\": \"%s\", \"inputs\": %llu, \"unit\": \"%s\"", function, range.name,
           static_cast<unsigned long long>(record.count), range.unit);
    print_number("ulps", record.ulps);
    print_number("error", record.units);
    print_number("charge", record.charge);
    print_number("share", record.share);
    printf(", \"error_at\": \"%s\", \"share_at\": \"%s\"}\n", at_units.c_str(), at_share.c_str());
    fflush(stdout);
}

template <class F> void measure(const F &f, uint64_t inputs) {
    const auto start = Clock::now();
    const std::vector<Record> records = sweep(f, inputs);
    for (int range = 0; range < F::RANGES; ++range) {
        const Record &record = records[range];
        if (!record.count) continue;
        print_row(F::NAME, F::ranges()[range], record, f.at(record.at_units), f.at(record.at_share));
    }
    fprintf(stderr, "%-32s %14llu inputs %6.2f s\n", F::NAME, static_cast<unsigned long long>(inputs),
            seconds_since(start));
}

// Mantissas against mantissas: all of the denominator's, as many of the numerator's as `seconds` allow.
void measure_mantissas(const Charges &c, double seconds, uint64_t sample) {
    const auto start = Clock::now();
    constexpr uint64_t MANTISSAS = 1ull << 23;
    uint64_t pairs = 0;
    Record record;
    float a = 1.f;
#ifdef HOST
    const uint64_t numerators = sample / MANTISSAS + 1;
    (void)seconds;
    for (uint64_t place = 0; place < numerators; ++place) {
        const float other = numerator(static_cast<uint32_t>(place) + 1);
        const Record found = sweep(QuotientsOf{other, c.division}, MANTISSAS)[0];
        if (larger_than(found.share, record.share)) record = found, a = other;
        pairs += MANTISSAS;
    }
#else
    constexpr uint32_t CHUNK = 1u << 21, SLICE = 1u << 20;
    std::vector<float> worst(CHUNK);
    float *device = nullptr;
    double most = -1.0;
    const uint64_t limit = sample ? sample : MANTISSAS * MANTISSAS;
    check(cudaMalloc(&device, CHUNK * sizeof(float)), "memory");
    auto in_time = [&] { return seconds_since(start) < seconds && pairs < limit; };
    for (uint32_t first = 0; first < MANTISSAS && in_time(); first += CHUNK) {
        check(cudaMemset(device, 0, CHUNK * sizeof(float)), "memory");
        for (uint32_t slice = 0; slice < MANTISSAS && in_time(); slice += SLICE) {
            residuals<<<CHUNK / PER_THREAD / THREADS, THREADS>>>(first, slice, SLICE, device);
            check(cudaGetLastError(), "launch");
            check(cudaDeviceSynchronize(), "kernel");
            pairs += static_cast<uint64_t>(CHUNK) * SLICE;
            fprintf(stderr, "a / b, mantissas %.3g pairs %6.2f s\n", static_cast<double>(pairs), seconds_since(start));
        }
        check(cudaMemcpy(worst.data(), device, CHUNK * sizeof(float), cudaMemcpyDeviceToHost), "kernel");
        for (uint32_t k = 0; k < CHUNK; ++k) {
            const float other = numerator(first + k);
            const double units = static_cast<double>(worst[k]) / static_cast<double>(other);
            if (larger_than(units, most)) most = units, a = other;
        }
    }
    check(cudaFree(device), "memory");
    record = sweep(QuotientsOf{a, c.division}, MANTISSAS)[0];
    // the two ways to find the largest error have to agree; the second looks at every denominator
    const double found = most / UNIT / record.units;
    const bool whole = pairs % (CHUNK * MANTISSAS) == 0;
    if (!(found <= 1.001 && (found >= 0.999 || !whole))) record.units = record.share = INFINITY;
#endif
    record.count = pairs;
    char at[96];
    snprintf(at, sizeof(at), "%.9g / %.9g", a, as_float(0x3f800000u | static_cast<uint32_t>(record.at_units)));
    // ulps are looked at for the worst numerator only
    record.ulps = NAN;
    const Range range{pairs == MANTISSAS * MANTISSAS ? "all pairs in [1, 2)" : "pairs in [1, 2)", "2^-24"};
    print_row("a / b, mantissas", range, record, at, at);
    fprintf(stderr, "%-32s %14.4g pairs  %6.2f s\n", "a / b, mantissas", static_cast<double>(pairs),
            seconds_since(start));
}

int main(int count, char **arguments) {
    std::map<std::string, double> options = {
        {"exp", 4}, {"exp_slope", 2.346}, {"log_absolute", 6}, {"log_ulps", 3}, {"sqrt", 6}, {"rsqrt", 4},
        {"division", 4}, {"flush", 1}, {"rotation", 52}, {"direction", 8},
        {"least_squared", TINY}, {"truncated", 0},
        // inputs of each function; 0: all, or many
        {"sample", 0}, {"seconds", 20}};
    for (int k = 1; k < count; ++k) {
        const std::string argument = arguments[k];
        const size_t equals = argument.find('=');
        const std::string name = argument.substr(0, equals);
        if (equals == std::string::npos || !options.count(name)) {
            fprintf(stderr, "error: %s is not NAME=NUMBER of a name that is known\n", arguments[k]);
            return 2;
        }
        options[name] = atof(argument.c_str() + equals + 1);
    }
#ifdef HOST
#if defined(__SSE2__)
    // FTZ and DAZ
    _mm_setcsr(_mm_getcsr() | 0x8040);
#elif defined(__aarch64__)
    uint64_t control;
    asm volatile("mrs %0, fpcr" : "=r"(control));
    asm volatile("msr fpcr, %0" : : "r"(control | 1u << 24));
#endif
    printf("{\"device\": \"host\", \"capability\": \"none\", \"cuda\": \"none\"}\n");
#else
    int devices = 0;
    if (cudaGetDeviceCount(&devices) != cudaSuccess || !devices) {
        fprintf(stderr, "error: no CUDA GPU is available; nothing was measured\n");
        return 2;
    }
    cudaDeviceProp properties;
    check(cudaGetDeviceProperties(&properties, 0), "device");
    multiprocessors = properties.multiProcessorCount;
    printf("{\"device\": \"%s\", \"capability\": \"%d.%d\", \"cuda\": \"%d.%d\"}\n", properties.name, properties.major,
           properties.minor, CUDART_VERSION / 1000, CUDART_VERSION % 1000 / 10);
#endif
    fflush(stdout);
    const Charges c{options["exp"], options["exp_slope"], options["log_absolute"], options["log_ulps"],
                    options["sqrt"], options["rsqrt"], options["division"], options["flush"],
                    options["rotation"], options["direction"], options["least_squared"], options["truncated"] != 0};
    const uint64_t sample = static_cast<uint64_t>(options["sample"]);
    const Patterns patterns{sample ? sample : 1ull << 32};
    const uint64_t inputs = patterns.inputs < 1ull << 32 ? patterns.inputs : 1ull << 32;
    measure(Exponential{patterns, c}, inputs);
    measure(Logarithm{patterns, c}, inputs);
    measure(Rooted<SquareRoot>{patterns, c}, inputs);
    measure(Rooted<ReciprocalRoot>{patterns, c}, inputs);
    measure(Reciprocal{patterns, c}, inputs);
    measure(Quotient{c}, sample ? sample : 1ull << 35);
    measure(Sums{c}, sample ? sample : 10000000000ull);
    measure(Rotation{c}, sample ? sample : 1ull << 30);
    measure(Direction{c}, sample ? sample : 1ull << 30);
    measure(NoNumber{c}, 16);
    measure_mantissas(c, options["seconds"], sample);
    return 0;
}
