// Two vectors of three numbers and one more, side by side: one of the processor's where it has registers for them, else a pair.
#pragma once
#include <cstdint>
#include <type_traits>

#include "lanes.h"

namespace {

template <class T> struct Four {
    typedef T type __attribute__((vector_size(4 * sizeof(T))));
};

template <class V> struct Halves {
    V first, second;
};
template <class V> inline Halves<V> operator+(Halves<V> a, Halves<V> b) { return {a.first + b.first, a.second + b.second}; }
template <class V> inline Halves<V> operator-(Halves<V> a, Halves<V> b) { return {a.first - b.first, a.second - b.second}; }
template <class V> inline Halves<V> operator*(Halves<V> a, Halves<V> b) { return {a.first * b.first, a.second * b.second}; }
template <class V, class T> inline Halves<V> operator*(T a, Halves<V> b) { return {a * b.first, a * b.second}; }

template <class V> inline V first_of(Halves<V> v) { return v.first; }
template <class V> inline V second_of(Halves<V> v) { return v.second; }
template <int K, class V> inline Halves<V> spread(Halves<V> v) { return {V{} + v.first[K], V{} + v.second[K]}; }

#if defined(__clang__) || __GNUC__ >= 12
// The sums of the first three numbers of each of three vectors.
template <class V> inline V sum_axes(V a, V b, V c) {
    if constexpr (sizeof(V) == 4 * sizeof(a[0])) {
        const V none = {}, low = __builtin_shufflevector(a, b, 0, 4, 1, 5), high = __builtin_shufflevector(a, b, 2, 6, 3, 7);
        const V other_low = __builtin_shufflevector(c, none, 0, 4, 1, 5), other_high = __builtin_shufflevector(c, none, 2, 6, 3, 7);
        const V x = __builtin_shufflevector(low, other_low, 0, 1, 4, 5), y = __builtin_shufflevector(low, other_low, 2, 3, 6, 7);
        return (x + y) + __builtin_shufflevector(high, other_high, 0, 1, 4, 5);
    } else {
        const V none = {};
        const V low = __builtin_shufflevector(a, b, 0, 8, 1, 9, 4, 12, 5, 13), high = __builtin_shufflevector(a, b, 2, 10, 3, 11, 6, 14, 7, 15);
        const V other_low = __builtin_shufflevector(c, none, 0, 8, 1, 9, 4, 12, 5, 13);
        const V other_high = __builtin_shufflevector(c, none, 2, 10, 3, 11, 6, 14, 7, 15);
        const V x = __builtin_shufflevector(low, other_low, 0, 1, 8, 9, 4, 5, 12, 13);
        const V y = __builtin_shufflevector(low, other_low, 2, 3, 10, 11, 6, 7, 14, 15);
        return (x + y) + __builtin_shufflevector(high, other_high, 0, 1, 8, 9, 4, 5, 12, 13);
    }
}

template <class V> inline void transpose(V* row) {
    if constexpr (sizeof(V) == 32) {
        const V a = __builtin_shufflevector(row[0], row[1], 0, 4, 2, 6), b = __builtin_shufflevector(row[0], row[1], 1, 5, 3, 7);
        const V c = __builtin_shufflevector(row[2], row[3], 0, 4, 2, 6), d = __builtin_shufflevector(row[2], row[3], 1, 5, 3, 7);
        row[0] = __builtin_shufflevector(a, c, 0, 1, 4, 5), row[1] = __builtin_shufflevector(b, d, 0, 1, 4, 5);
        row[2] = __builtin_shufflevector(a, c, 2, 3, 6, 7), row[3] = __builtin_shufflevector(b, d, 2, 3, 6, 7);
    } else {
        const V a = __builtin_shufflevector(row[0], row[1], 0, 4, 1, 5), b = __builtin_shufflevector(row[0], row[1], 2, 6, 3, 7);
        const V c = __builtin_shufflevector(row[2], row[3], 0, 4, 1, 5), d = __builtin_shufflevector(row[2], row[3], 2, 6, 3, 7);
        row[0] = __builtin_shufflevector(a, c, 0, 1, 4, 5), row[1] = __builtin_shufflevector(a, c, 2, 3, 6, 7);
        row[2] = __builtin_shufflevector(b, d, 0, 1, 4, 5), row[3] = __builtin_shufflevector(b, d, 2, 3, 6, 7);
    }
}

template <class V> inline auto first_of(V v) { return __builtin_shufflevector(v, v, 0, 1, 2, 3); }
template <class V> inline auto second_of(V v) { return __builtin_shufflevector(v, v, 4, 5, 6, 7); }
template <int K, class V> inline V spread(V v) { return __builtin_shufflevector(v, v, K, K, K, K, K + 4, K + 4, K + 4, K + 4); }

template <class T> struct Eight {
    typedef T type __attribute__((vector_size(8 * sizeof(T))));
};
template <class T> struct Pair {
    typedef typename std::conditional<8 * sizeof(T) <= REGISTER, typename Eight<T>::type, Halves<typename Four<T>::type>>::type type;
};
#else
template <class V> inline V sum_axes(V a, V b, V c) { return V{a[0] + a[1] + a[2], b[0] + b[1] + b[2], c[0] + c[1] + c[2], 0}; }
template <class V> inline void transpose(V* row) {
    for (int i = 0; i < 4; ++i)
        for (int k = 0; k < i; ++k) {
            const auto one = row[i][k];
            row[i][k] = row[k][i], row[k][i] = one;
        }
}
template <class T> struct Pair {
    typedef Halves<typename Four<T>::type> type;
};
#endif
template <class V> inline Halves<V> sum_axes(Halves<V> a, Halves<V> b, Halves<V> c) {
    return {sum_axes(a.first, b.first, c.first), sum_axes(a.second, b.second, c.second)};
}

// Writes every lane of N vectors beside each other, the lanes STRIDE numbers apart: four by four.
template <int N, int STRIDE, class T> inline void store_by_lane(const VN (&values)[N], T* target) {
    typedef typename Four<T>::type V4;
    typedef T Lanes __attribute__((vector_size(AT_ONCE * sizeof(T))));
    constexpr int FOURS = AT_ONCE % 4 ? 0 : N / 4;
    for (int n = 4 * FOURS; n < N; ++n)
        for (int lane = 0; lane < AT_ONCE; ++lane) target[lane * STRIDE + n] = (T)values[n][lane];
#pragma GCC unroll 8
    for (int n = 0; n < 4 * FOURS; n += 4)
#pragma GCC unroll 2
        for (int from = 0; from < AT_ONCE; from += 4) {
            V4 row[4];
            for (int k = 0; k < 4; ++k) {
                const Lanes all = __builtin_convertvector(values[n + k], Lanes);
                std::memcpy(&row[k], (const T*)&all + from, sizeof(V4));
            }
            transpose(row);
            for (int lane = 0; lane < 4; ++lane) store(target + (from + lane) * STRIDE + n, row[lane]);
        }
}

// Two vectors of four from places of their own.
template <class T> inline typename Pair<T>::type load_both(const T* first, const T* second) {
    typedef typename Four<T>::type V4;
    if constexpr (std::is_same<typename Pair<T>::type, Halves<V4>>::value) {
        return {load<V4>(first), load<V4>(second)};
    } else {
        return __builtin_shufflevector(load<V4>(first), load<V4>(second), 0, 1, 2, 3, 4, 5, 6, 7);
    }
}

}  // namespace
