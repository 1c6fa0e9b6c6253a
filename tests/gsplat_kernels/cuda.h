// What gsplat's kernels need of CUDA, for one thread at a time on a CPU.
//
// REAL_KIND: 0 double; 1 float; 2 Fast, float32 with the errors of --use_fast_math.
#pragma once

#include <cassert>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <type_traits>

#define __global__
#define __device__
#define __host__
#define __forceinline__ inline
#define __restrict__
#define __launch_bounds__(...)
#define GSPLAT_PRAGMA_UNROLL

// --- Operations that are not correctly rounded on the device ---------------------------------------------------------

// splitmix64
struct Random {
    uint64_t state = 0;
    uint64_t next() {
        uint64_t z = (state += 0x9e3779b97f4a7c15ull);
        z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ull;
        z = (z ^ (z >> 27)) * 0x94d049bb133111ebull;
        return z ^ (z >> 31);
    }
};

enum Operation { DIVISION, SQUARE_ROOT, RECIPROCAL_ROOT, EXPONENTIAL, LOGARITHM, OPERATIONS };

struct Noise {
    Random random;
    // 0: anywhere within the error; 1: at either end of it; 2: always the same end for one operation
    int kind = 0;
    double ends[OPERATIONS] = {};

    // in [-1, 1]
    double draw(Operation operation) {
        if (kind == 2) return ends[operation];
        const double uniform = static_cast<double>(random.next() >> 11) * 0x1p-52 - 1.0;
        return kind == 1 ? std::copysign(1.0, uniform) : uniform;
    }
};

inline Noise noise;

inline double ulp(double exact) {
    int exponent;
    std::frexp(exact, &exponent);
    return std::ldexp(1.0, std::max(exponent, -125) - 24);
}

// A float within `ulps` ulps of `exact`; rounding takes half of one.
inline float erring(double exact, double ulps, Operation operation) {
    if (!std::isfinite(exact) || exact == 0.0) return static_cast<float>(exact);
    return static_cast<float>(exact + (ulps - 0.5) * ulp(exact) * noise.draw(operation));
}

// float32 with the errors that the CUDA C++ Programming Guide states for --use_fast_math ("Mathematical Functions").
// Subnormals are flushed by the processor, see `Flushed`.
struct Fast {
    float value;

    Fast() = default;
    Fast(float x) : value(x) {}
    Fast(double x) : value(static_cast<float>(x)) {}
    Fast(int x) : value(static_cast<float>(x)) {}
    Fast(unsigned x) : value(static_cast<float>(x)) {}
    explicit operator float() const { return value; }
    explicit operator double() const { return value; }

    Fast operator-() const { return -value; }
    Fast operator+() const { return *this; }
    friend Fast operator+(Fast a, Fast b) { return a.value + b.value; }
    friend Fast operator-(Fast a, Fast b) { return a.value - b.value; }
    friend Fast operator*(Fast a, Fast b) { return a.value * b.value; }
    friend Fast operator/(Fast a, Fast b) {
        return erring(static_cast<double>(a.value) / b.value, 2.0, DIVISION);
    }
    Fast &operator+=(Fast b) { return *this = *this + b; }
    Fast &operator-=(Fast b) { return *this = *this - b; }
    Fast &operator*=(Fast b) { return *this = *this * b; }
    Fast &operator/=(Fast b) { return *this = *this / b; }
#define COMPARISON(op)                                                                                                 \
    friend bool operator op(Fast a, Fast b) { return a.value op b.value; }                                             \
    friend bool operator op(Fast a, double b) { return a.value op b; }                                                 \
    friend bool operator op(double a, Fast b) { return a op b.value; }
    COMPARISON(<) COMPARISON(<=) COMPARISON(>) COMPARISON(>=) COMPARISON(==) COMPARISON(!=)
#undef COMPARISON
};
static_assert(sizeof(Fast) == sizeof(float));
template <> struct std::numeric_limits<Fast> : std::numeric_limits<float> {};

#if REAL_KIND == 0
using real = double;
#elif REAL_KIND == 1
using real = float;
#else
using real = Fast;
#endif

#define GLM_FORCE_UNRESTRICTED_GENTYPE
#include <glm/glm.hpp>
#include <glm/gtc/type_ptr.hpp>

// --- Conversions to integers saturate on the device, and NaN becomes 0 -----------------------------------------------

template <class Integer> struct Saturated {
    Integer value;
    explicit Saturated(Fast x) : Saturated(static_cast<double>(x)) {}
    template <class T, std::enable_if_t<std::is_arithmetic_v<T>, int> = 0> explicit Saturated(T x) {
        const double least = std::numeric_limits<Integer>::min(), most = std::numeric_limits<Integer>::max();
        const double given = static_cast<double>(x);
        value = given != given ? 0 : given <= least ? std::numeric_limits<Integer>::min()
                                 : given >= most    ? std::numeric_limits<Integer>::max()
                                                    : static_cast<Integer>(given);
    }
    operator Integer() const { return value; }
};
using saturated_int = Saturated<int32_t>;
using saturated_unsigned = Saturated<uint32_t>;

namespace at {
template <class T> using opmath_type = T;
}

namespace gsplat {

// --- Functions -------------------------------------------------------------------------------------------------------

template <class T> struct Plain { using type = T; };
template <class T> struct Plain<Saturated<T>> { using type = T; };

// a NaN gives way
template <class A, class B> auto max(A a_, B b_) {
    using T = std::common_type_t<typename Plain<A>::type, typename Plain<B>::type>;
    const T a = a_, b = b_;
    return a > b || b != b ? a : b;
}
template <class A, class B> auto min(A a_, B b_) {
    using T = std::common_type_t<typename Plain<A>::type, typename Plain<B>::type>;
    const T a = a_, b = b_;
    return a < b || b != b ? a : b;
}
inline real fminf(real a, real b) { return min(a, b); }

#if REAL_KIND == 2
inline double wide(real x) { return x.value; }
inline real sqrt(real x) { return erring(std::sqrt(wide(x)), 3.0, SQUARE_ROOT); }
inline real rsqrt(real x) { return erring(1.0 / std::sqrt(wide(x)), 2.0, RECIPROCAL_ROOT); }
inline real __expf(real x) {
    return erring(std::exp(wide(x)), 2.0 + std::floor(std::abs(1.173 * wide(x))), EXPONENTIAL);
}
inline real __logf(real x) {
    const double exact = std::log(wide(x));
    if (x.value < 0.5f || x.value > 2.0f) return erring(exact, 3.0, LOGARITHM);
    return static_cast<float>(exact + 0x1p-21 * 0.75 * noise.draw(LOGARITHM));
}
inline real floor(real x) { return std::floor(x.value); }
inline real ceil(real x) { return std::ceil(x.value); }
#else
inline real sqrt(real x) { return std::sqrt(x); }
inline real rsqrt(real x) { return real(1) / std::sqrt(x); }
inline real __expf(real x) { return std::exp(x); }
inline real __logf(real x) { return std::log(x); }
inline real floor(real x) { return std::floor(x); }
inline real ceil(real x) { return std::ceil(x); }
#endif
inline real sqrtf(real x) { return sqrt(x); }
inline real rsqrtf(real x) { return rsqrt(x); }
inline real rsqrt_parse_safe(real x) { return rsqrt(x); }
inline real ceilf(real x) { return ceil(x); }
inline uint32_t __float_as_uint(real x) {
    const float narrow = static_cast<float>(x);
    uint32_t bits;
    std::memcpy(&bits, &narrow, sizeof bits);
    return bits;
}

// --- Threads: a grid of one thread, whose place is set from outside --------------------------------------------------

struct uint3 { uint32_t x, y, z; };
struct uint2 { uint32_t x, y; };
struct int2 { int32_t x, y; };
struct real2 { real x, y; };

inline uint3 blockIdx, threadIdx;
inline uint32_t grid_rank;

inline void __syncthreads() {}
inline void __syncwarp() {}
inline int __syncthreads_count(bool predicate) { return predicate; }

namespace cooperative_groups {
struct Grid { uint32_t thread_rank() const { return grid_rank; } };
struct Block {
    uint3 group_index() const { return blockIdx; }
    uint3 thread_index() const { return threadIdx; }
    uint32_t thread_rank() const { return 0; }
    uint32_t size() const { return 1; }
    void sync() const {}
};
inline Grid this_grid() { return {}; }
inline Block this_thread_block() { return {}; }
}  // namespace cooperative_groups
namespace cg = cooperative_groups;

// --- Names of gsplat's own headers -----------------------------------------------------------------------------------

#if TEMPLATED_TYPES
template <typename T> using vec2 = glm::vec<2, T>;
template <typename T> using vec3 = glm::vec<3, T>;
template <typename T> using vec4 = glm::vec<4, T>;
template <typename T> using mat2 = glm::mat<2, 2, T>;
template <typename T> using mat3 = glm::mat<3, 3, T>;
template <typename T> using mat3x2 = glm::mat<3, 2, T>;
template <typename T> struct OpType { using type = T; };
using real_vec2 = vec2<real>;
using real_vec3 = vec3<real>;
#else
using vec2 = glm::vec<2, real>;
using vec3 = glm::vec<3, real>;
using vec4 = glm::vec<4, real>;
using mat2 = glm::mat<2, 2, real>;
using mat3 = glm::mat<3, 3, real>;
using mat3x2 = glm::mat<3, 2, real>;
using real_vec2 = vec2;
using real_vec3 = vec3;
#endif

enum CameraModelType { PINHOLE, ORTHO, FISHEYE };
// never called: the cameras are pinholes
template <class T = void, class... A> void ortho_proj(A &&...) { assert(false); }
template <class T = void, class... A> void fisheye_proj(A &&...) { assert(false); }

}  // namespace gsplat
