// Triangles of a mesh in eights that lie together, in a tree of boxes: the order belongs to the topology, the rest to a call.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "lanes.h"
#include "threads.h"
#include "vector.h"

extern "C" {

struct Eights {
    int64_t num_vertices, num_faces, num_leaves;
    const double* pos;      // (V, 3) m
    const int64_t* faces;   // (F, 3)
    int32_t* order;         // (L, 8) the faces, -1 behind the last one
    int32_t* vertex;        // (L, 3, 8) their corners in ascending order
    double* corner;         // (L, 9, 8) m, where these are about the origin of a call
    double* normal;         // (L, 3, 8) unit normals, zero without an area; of leaves that this call needed
    double* boxes;          // (L, 6, 8) m, least and greatest corners
    double* groups;         // (G, 6, 8) m, those of eight leaves, then of eight of these, level after level
    uint8_t* has_normals;   // (L) whether they are made, see normals()
};
}

namespace {

constexpr int MOST_LEVELS = 12;
constexpr double EPS = 2.220446049250313e-16;

typedef int8_t BN __attribute__((vector_size(AT_ONCE)));
typedef int32_t NN __attribute__((vector_size(4 * AT_ONCE)));

// A byte of 1 for every one of eight lanes that holds, the first one lowest; by parts that begin at a number.
template <class Part> inline uint64_t lanes_of(const Part& part) {
    uint64_t all = 0;
    for (int i = 0; i < LANES; i += AT_ONCE) {
        const BN bytes = __builtin_convertvector(part(i), BN);
        uint64_t bits = 0;
        std::memcpy(&bits, &bytes, sizeof(bytes));
        all |= bits << 8 * i;
    }
    return all & 0x0101010101010101u;
}
template <class Visit> inline void each_lane(uint64_t lanes, Visit visit) {
    for (; lanes; lanes &= lanes - 1) visit(__builtin_ctzll(lanes) / 8);
}

inline VN lower(VN a, VN b) { return a < b ? a : b; }
inline VN higher(VN a, VN b) { return a > b ? a : b; }

struct Box {
    double low[3], high[3];
};

inline Box box_in(const double* sides, int lane) {
    Box box;
    for (int k = 0; k < 3; ++k) box.low[k] = sides[LANES * k + lane], box.high[k] = sides[LANES * (3 + k) + lane];
    return box;
}

// Which of eight boxes a box overlaps or touches.
inline uint64_t overlapped(const double* sides, const Box& box) {
    return lanes_of([&](int i) {
        IN apart = IN{};
        for (int k = 0; k < 3; ++k)
            apart |= (load<VN>(sides + LANES * k + i) > box.high[k]) | (load<VN>(sides + LANES * (3 + k) + i) < box.low[k]);
        return ~apart;
    });
}

// What is around eight boxes goes to a lane of others.
inline void surround(const double* sides, double* into, int lane) {
    for (int k = 0; k < 3; ++k) {
        double low = INFINITY, high = -INFINITY;
        for (int i = 0; i < LANES; ++i) low = std::min(low, sides[LANES * k + i]), high = std::max(high, sides[LANES * (3 + k) + i]);
        into[LANES * k + lane] = low, into[LANES * (3 + k) + lane] = high;
    }
}

// Where the levels of groups begin, and how many there are; the last one is a single group.
struct Levels {
    int64_t first[MOST_LEVELS + 1];
    int count = 0;

    explicit Levels(int64_t leaves) {
        first[0] = 0;
        for (int64_t size = leaves; size > 1 || count == 0; ++count) {
            size = (size + LANES - 1) / LANES;
            first[count + 1] = first[count] + size;
        }
    }
};

// Boxes of groups, from those of the leaves up; a box without anything in it overlaps nothing.
inline void fit_groups(const double* boxes, int64_t num_leaves, double* groups) {
    const Levels levels(num_leaves);
    const double* from = boxes;
    int64_t size = num_leaves;
    for (int level = 0; level < levels.count; ++level) {
        const int64_t next = levels.first[level + 1] - levels.first[level];
        double* into = groups + 6 * LANES * levels.first[level];
        for (int64_t i = 0; i < 6 * LANES * next; ++i) into[i] = i / (3 * LANES) % 2 ? -INFINITY : INFINITY;
        for (int64_t i = 0; i < size; ++i) surround(from + 6 * LANES * i, into + 6 * LANES * (i / LANES), i % LANES);
        from = into, size = next;
    }
}

// Visits the leaves, below a number, whose boxes ``near`` picks from eight.
template <class Near, class Visit>
inline void visit_leaves(const double* groups, const Levels& levels, int64_t end, Near near, Visit visit) {
    struct {
        int level;
        int64_t group;
    } left[MOST_LEVELS * LANES];
    int count = 0;
    left[count++] = {levels.count - 1, 0};
    while (count) {
        const auto now = left[--count];
        each_lane(near(groups + 6 * LANES * (levels.first[now.level] + now.group)), [&](int lane) {
            const int64_t item = LANES * now.group + lane;
            if (now.level) left[count++] = {now.level - 1, item};
            else if (item < end) visit(item);
        });
    }
}

// Takes up where the corners of some leaves are now, about an origin. Triangles that are not finite get a box that overlaps
// nothing.
inline void place_leaves(const Eights& e, const double* origin, Range leaves) {
    for (int64_t leaf = leaves.begin; leaf < leaves.end; ++leaf) {
        double* corner = e.corner + 9 * LANES * leaf;
        const int32_t* vertex = e.vertex + 3 * LANES * leaf;
        for (int c = 0; c < 3; ++c)
            for (int i = 0; i < LANES; ++i)
                for (int k = 0; k < 3; ++k)
                    corner[LANES * (3 * c + k) + i] = e.pos[3 * (int64_t)vertex[LANES * c + i] + k];
        for (int at = 0; at < LANES; at += AT_ONCE) {
            IN usable = __builtin_convertvector(load<NN>(e.order + LANES * leaf + at) >= 0, IN);
            VN value[9];
            for (int j = 0; j < 9; ++j) {
                value[j] = load<VN>(corner + LANES * j + at) - origin[j % 3];
                store(corner + LANES * j + at, value[j]);
                usable &= value[j] - value[j] == 0.0;
            }
            for (int k = 0; k < 3; ++k) {
                const VN a = value[k], b = value[3 + k], c = value[6 + k];
                store(e.boxes + LANES * (6 * leaf + k) + at, usable ? lower(lower(a, b), c) : every(INFINITY));
                store(e.boxes + LANES * (6 * leaf + 3 + k) + at, usable ? higher(higher(a, b), c) : every(-INFINITY));
            }
        }
        e.has_normals[leaf] = 0;
    }
}

inline void place(const Eights& e, const double* origin, int64_t parts) {
    for_parts(parts, [&](int64_t part) { place_leaves(e, origin, range_of(e.num_leaves, part, parts)); });
    fit_groups(e.boxes, e.num_leaves, e.groups);
}

// Unit normals of the triangles of a leaf, made by the first thread that asks.
inline const double* normals(const Eights& e, int64_t leaf) {
    enum : uint8_t { NONE, BEGUN, MADE };
    double* normal = e.normal + 3 * LANES * leaf;
    uint8_t* state = e.has_normals + leaf;
    while (true) {
        uint8_t now = __atomic_load_n(state, __ATOMIC_ACQUIRE);
        if (now == MADE) return normal;
        if (now == NONE && __atomic_compare_exchange_n(state, &now, BEGUN, false, __ATOMIC_ACQUIRE, __ATOMIC_ACQUIRE)) break;
        std::this_thread::yield();
    }
    for (int at = 0; at < LANES; at += AT_ONCE) {
        const double* corner = e.corner + 9 * LANES * leaf + at;
        VN first[3], second[3], product[3];
        for (int k = 0; k < 3; ++k) {
            const VN a = load<VN>(corner + LANES * k);
            first[k] = load<VN>(corner + LANES * (3 + k)) - a, second[k] = load<VN>(corner + LANES * (6 + k)) - a;
        }
        cross(first, second, product);
        const VN length = root(dot(product, product)), limit = 16.0 * EPS * root(dot(first, first)) * root(dot(second, second));
        // Below this the direction is rounding alone.
        const IN flat = length <= limit;
        for (int k = 0; k < 3; ++k) store(normal + LANES * k + at, flat ? every(0.0) : 1.0 / length * product[k]);
    }
    __atomic_store_n(state, MADE, __ATOMIC_RELEASE);
    return normal;
}

// Lanes whose corners lie on both sides of planes; planes by a point and a normal, each in lanes or one for all.
template <class Corner, class Point, class Normal>
inline IN on_both_sides(Corner corner, Point point, Normal normal, double touch) {
    IN below = IN{}, above = IN{};
    for (int c = 0; c < 3; ++c) {
        VN away[3], up[3];
        for (int k = 0; k < 3; ++k) away[k] = corner(c, k) - point(k), up[k] = every(0.0) + normal(k);
        const VN height = dot(away, up);
        below |= height < -touch, above |= height > touch;
    }
    return below & above;
}

}  // namespace
