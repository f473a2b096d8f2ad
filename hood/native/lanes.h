// Eight numbers at a time, one per element of a mesh, in float64.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstring>

namespace {

constexpr int LANES = 8;

typedef double V8 __attribute__((vector_size(64)));
typedef decltype(V8{} < V8{}) I8;

template <class V, class T> inline V load(const T* p) {
    V v;
    std::memcpy(&v, p, sizeof(V));
    return v;
}
template <class T, class V> inline void store(T* p, V v) { std::memcpy(p, &v, sizeof(V)); }

// The number of every lane. Put together in memory it would be waited for, ten times as long, before it could be loaded as one.
template <class Number> inline V8 lanes(const Number& number) {
    return V8{number(0), number(1), number(2), number(3), number(4), number(5), number(6), number(7)};
}
inline V8 all(double x) { return V8{x, x, x, x, x, x, x, x}; }
inline double total(V8 v) { return ((v[0] + v[4]) + (v[1] + v[5])) + ((v[2] + v[6]) + (v[3] + v[7])); }
inline V8 root(V8 v) {
    alignas(64) double lanes[LANES];
    store(lanes, v);
    for (int i = 0; i < LANES; ++i) lanes[i] = std::sqrt(lanes[i]);
    return load<V8>(lanes);
}
inline V8 magnitude(V8 v) { return v < 0.0 ? -v : v; }
inline V8 dot(const V8* a, const V8* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline void cross(const V8* a, const V8* b, V8* c) {
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

// Offsets [m] of the other corners of eight elements from the first, by positions in rows of ROW numbers.
template <int CORNERS, int ROW> inline void offsets_of(const double* pos, const int32_t* corners, int64_t padded, V8 (*offset)[3]) {
    const auto place = [&](int c, int k) {
        return lanes([&](int lane) { return pos[ROW * (int64_t)corners[c * padded + lane] + k]; });
    };
    const V8 first[3] = {place(0, 0), place(0, 1), place(0, 2)};
    for (int c = 1; c < CORNERS; ++c)
        for (int k = 0; k < 3; ++k) offset[c - 1][k] = place(c, k) - first[k];
}

// Coefficients of (atan(t) / t - 1) / t^2 in t^2 up to tan(pi / 8), a Chebyshev fit with an error of 5e-18.
constexpr double ATAN[] = {
    -0.333333333333333302,  0.199999999999955207,   -0.142857142846665429,  0.111111110152563617,
    -0.0909090457812390186, 0.0769218319082608591,  -0.0666451144738193878, 0.0585814891280212981,
    -0.0508544973793984085, 0.0392316582955750863,  -0.0191768871190474343};

inline V8 angle_of(V8 y, V8 x) {
    const double quarter = 0.78539816339744830962, pi = 3.14159265358979323846;
    const V8 a = magnitude(y), b = magnitude(x), zero = all(0.0), one = all(1.0);
    const I8 steep = a > b;
    const V8 low = steep ? b : a, high = steep ? a : b;
    const I8 wide = low > 0.41421356237309504880 * high;
    const V8 top = wide ? low - high : low, bottom = wide ? low + high : high;
    const V8 t = top / (bottom > zero ? bottom : one), z = t * t;
    V8 sum = all(ATAN[10]);
    for (int i = 9; i >= 0; --i) sum = sum * z + ATAN[i];
    V8 angle = t + t * z * sum;
    angle = wide ? angle + quarter : angle;
    angle = steep ? 0.5 * pi - angle : angle;
    angle = x < 0.0 ? pi - angle : angle;
    return y < 0.0 ? -angle : angle;
}

}  // namespace
