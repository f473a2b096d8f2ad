// Arithmetic of pictures, on as many float32 numbers at a time as a register holds.
#pragma once
#include <cmath>

#include "floats.h"
#include "vector.h"

namespace {

typedef int32_t Ints __attribute__((vector_size(4 * LANES)));

// The number of every lane. Put together in memory it would be waited for before it could be loaded as one.
#if defined(__AVX512F__)
template <class Number> inline V gather(const Number& number) {
    return V{number(0), number(1), number(2),  number(3),  number(4),  number(5),  number(6),  number(7),
             number(8), number(9), number(10), number(11), number(12), number(13), number(14), number(15)};
}
#elif defined(__AVX__)
template <class Number> inline V gather(const Number& number) {
    return V{number(0), number(1), number(2), number(3), number(4), number(5), number(6), number(7)};
}
#else
template <class Number> inline V gather(const Number& number) { return V{number(0), number(1), number(2), number(3)}; }
#endif

// What a table holds at places of memory.
template <class T> inline V looked_up(const T* table, const int32_t* place) {
    return gather([&](int i) { return (float)table[place[i]]; });
}
inline Ints load(const int32_t* p) {
    Ints v;
    std::memcpy(&v, p, sizeof v);
    return v;
}
inline void store(int32_t* p, Ints v) { std::memcpy(p, &v, sizeof v); }
inline V counted() {
    return gather([](int i) { return (float)i; });
}
inline Ints whole(V v) { return __builtin_convertvector(v, Ints); }
inline V real(Ints v) { return __builtin_convertvector(v, V); }
inline bool any(Ints lanes) {
    uint64_t parts[sizeof(Ints) / 8], all = 0;
    std::memcpy(parts, &lanes, sizeof lanes);
    for (const uint64_t part : parts) all |= part;
    return all != 0;
}
inline V root(V v) {
    alignas(sizeof(V)) float lanes[LANES];
    store(lanes, v);
    for (float& lane : lanes) lane = std::sqrt(lane);
    return load(lanes);
}
inline V magnitude(V v) { return (V)((Ints)v & 0x7fffffff); }
inline V higher(V a, V b) { return a > b ? a : b; }  // b where a is no number
inline V lower(V a, V b) { return a < b ? a : b; }
inline V clip(V v, float low, float high) { return lower(higher(v, all(low)), all(high)); }
inline V rounded_down(V v) {
    const V cut = real(whole(v));
    return cut > v ? cut - 1.0f : cut;
}

// 2^v to a share of 3e-6, from -126 to 127.
inline V exponential(V v) {
    const V below = rounded_down(v), f = v - below;
    const V part = 1.00000259f + f * (0.69300387f + f * (0.24144267f + f * (0.05201152f + f * 0.01353417f)));
    return part * (V)((whole(below) + 127) << 23);
}
// Of numbers above zero, to 1.5e-5.
inline V logarithm(V v) {
    const Ints bits = (Ints)v;
    const V f = (V)((bits & 0x007fffff) | 0x3f800000) - 1.0f;
    const V part = f * (1.44196556f + f * (-0.70966212f + f * (0.41759333f + f * (-0.1962663f + f * 0.04638382f))));
    return real((bits >> 23) - 127) + part;
}
// The numbers 0 to 255 by which linear colours are shown, before they are rounded.
inline V shown(V linear) { return 255.0f * exponential(logarithm(clip(linear, 1e-12f, 1.0f)) * (float)(1.0 / 2.2)); }

// Vectors of three.
struct Three {
    V x, y, z;
};
inline Three operator+(Three a, Three b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Three operator*(V s, Three a) { return {s * a.x, s * a.y, s * a.z}; }
inline V dot(Three a, Three b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Three unit(Three a) { return (1.0f / root(higher(dot(a, a), all(1e-24f)))) * a; }
inline Three every(const double* p) { return {all((float)p[0]), all((float)p[1]), all((float)p[2])}; }

}  // namespace
