// Numbers at a time, in float64: eight in the tables of trees, whatever the processor; one per element of a mesh, as many as a
// register holds. Wider ones would be taken apart by the compiler, which keeps their parts in memory.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstring>

#include "registers.h"

namespace {

constexpr int LANES = 8;
constexpr int AT_ONCE = REGISTER / 8;  // divides the eight to which tables of elements are padded

typedef double VN __attribute__((vector_size(8 * AT_ONCE)));
typedef decltype(VN{} < VN{}) IN;

template <class V, class T> inline V load(const T* p) {
    V v;
    std::memcpy(&v, p, sizeof(V));
    return v;
}
template <class T, class V> inline void store(T* p, V v) { std::memcpy(p, &v, sizeof(V)); }

inline VN every(double x) { return VN{} + x; }

// The number of every lane. Put together in memory it would be waited for, ten times as long, before it could be loaded as one.
#if defined(__AVX512F__)
template <class Number> inline VN gather(const Number& number) {
    return VN{number(0), number(1), number(2), number(3), number(4), number(5), number(6), number(7)};
}
inline double total(VN v) { return ((v[0] + v[4]) + (v[1] + v[5])) + ((v[2] + v[6]) + (v[3] + v[7])); }
#elif defined(__AVX__)
template <class Number> inline VN gather(const Number& number) { return VN{number(0), number(1), number(2), number(3)}; }
inline double total(VN v) { return (v[0] + v[2]) + (v[1] + v[3]); }
#else
template <class Number> inline VN gather(const Number& number) { return VN{number(0), number(1)}; }
inline double total(VN v) { return v[0] + v[1]; }
#endif

template <class V> inline V root(V v) {
    alignas(sizeof(V)) double lanes[sizeof(V) / sizeof(double)];
    store(lanes, v);
    for (double& lane : lanes) lane = std::sqrt(lane);
    return load<V>(lanes);
}
template <class V> inline V magnitude(V v) { return v < 0.0 ? -v : v; }
template <class V> inline V dot(const V* a, const V* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
template <class V> inline void cross(const V* a, const V* b, V* c) {
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

// Offsets [m] of the other corners of elements from the first, by positions in rows of ROW numbers.
template <int CORNERS, int ROW> inline void offsets_of(const double* pos, const int32_t* corners, int64_t padded, VN (*offset)[3]) {
    const auto place = [&](int c, int k) {
        return gather([&](int lane) { return pos[ROW * (int64_t)corners[c * padded + lane] + k]; });
    };
    const VN first[3] = {place(0, 0), place(0, 1), place(0, 2)};
    for (int c = 1; c < CORNERS; ++c)
        for (int k = 0; k < 3; ++k) offset[c - 1][k] = place(c, k) - first[k];
}

// Coefficients of (atan(t) / t - 1) / t^2 in t^2 up to tan(pi / 8), a Chebyshev fit with an error of 5e-18.
constexpr double ATAN[] = {
    -0.333333333333333302,  0.199999999999955207,   -0.142857142846665429,  0.111111110152563617,
    -0.0909090457812390186, 0.0769218319082608591,  -0.0666451144738193878, 0.0585814891280212981,
    -0.0508544973793984085, 0.0392316582955750863,  -0.0191768871190474343};

inline VN angle_of(VN y, VN x) {
    const double quarter = 0.78539816339744830962, pi = 3.14159265358979323846;
    const VN a = magnitude(y), b = magnitude(x), zero = every(0.0), one = every(1.0);
    const IN steep = a > b;
    const VN low = steep ? b : a, high = steep ? a : b;
    const IN wide = low > 0.41421356237309504880 * high;
    const VN top = wide ? low - high : low, bottom = wide ? low + high : high;
    const VN t = top / (bottom > zero ? bottom : one), z = t * t;
    VN sum = every(ATAN[10]);
    for (int i = 9; i >= 0; --i) sum = sum * z + ATAN[i];
    VN angle = t + t * z * sum;
    angle = wide ? angle + quarter : angle;
    angle = steep ? 0.5 * pi - angle : angle;
    angle = x < 0.0 ? pi - angle : angle;
    return y < 0.0 ? -angle : angle;
}

}  // namespace
