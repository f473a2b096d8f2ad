// How far two features of a cloth may go on straight lines before they meet.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <utility>

#include "layer_distance.h"

namespace {

constexpr int MOST_ADVANCES = 60;  // what has been gone by then is safe as well
// Of the reach: below it a pair may hardly come nearer; and pairs that stop held vertices.
constexpr double NARROW = 1e-2, PINCHED = 0.3;

// Takes the mean off the ways of the corners; how far points of the features then move towards each other at most.
inline double relative_way(int32_t edges, Vec* p) {
    const Vec mean = 0.25 * (p[0] + p[1] + p[2] + p[3]);
    double size[4];
    for (int i = 0; i < 4; ++i) p[i] = p[i] - mean, size[i] = dot(p[i], p[i]);
    return edges ? std::sqrt(std::max(size[0], size[1])) + std::sqrt(std::max(size[2], size[3]))
                 : std::sqrt(size[0]) + std::sqrt(std::max(size[1], std::max(size[2], size[3])));
}

// Along straight lines from x by p: the first time at which two features may be within ``kept`` of each other, seen in one direction
// of unit length in which all of the first is at least ``dist`` beyond all of the second. What slides past does not count.
inline double slab_time(int32_t edges, const Vec* x, const Vec* p, Vec normal, double kept) {
    const int split = edges ? 2 : 1;
    double time = std::numeric_limits<double>::infinity();
    for (int a = 0; a < split; ++a)
        for (int b = split; b < 4; ++b) {
            const double closing = -dot(normal, p[a] - p[b]);
            if (closing > 0.0) time = std::min(time, std::max(dot(normal, x[a] - x[b]) - kept, 0.0) / closing);
        }
    return time;
}

// The smallest root in 0..1 of a polynomial of degree 3 that is positive at 0, or a little less; 1 without any.
inline double first_root(const double* c) {
    const auto value = [&](double t) { return c[0] + t * (c[1] + t * (c[2] + t * c[3])); };
    double turn[3] = {1.0, 1.0, 1.0};  // where it turns, and the end
    const double root = c[2] * c[2] - 3.0 * c[1] * c[3];
    if (root >= 0.0) {
        const double q = -(c[2] + (c[2] < 0.0 ? -std::sqrt(root) : std::sqrt(root)));
        const double first = q / (3.0 * c[3]), second = c[1] / q;
        turn[0] = first > 0.0 && first < 1.0 ? first : 1.0, turn[1] = second > 0.0 && second < 1.0 ? second : 1.0;
        if (turn[0] > turn[1]) std::swap(turn[0], turn[1]);
    }
    double low = 0.0;
    for (double high : turn) {
        if (value(high) > 0.0) {
            low = high;
            continue;
        }
        for (int i = 0; i < 40; ++i) {
            const double middle = 0.5 * (low + high);
            (value(middle) > 0.0 ? low : high) = middle;
        }
        return low;
    }
    return 1.0;
}

// The same for features whose nearest points are inside them: as long as the point is so far off the face's plane, or the lines of
// the edges so far apart. Those come near only where all four corners are nearly in one plane, at a root of a cubic.
inline double plane_time(int32_t edges, const Vec* x, const Vec* p, double kept) {
    const int i = edges ? 2 : 1;
    const Vec w = x[0] - x[i], dw = p[0] - p[i];
    const Vec u = edges ? x[1] - x[0] : x[2] - x[1], du = edges ? p[1] - p[0] : p[2] - p[1];
    const Vec v = edges ? x[3] - x[2] : x[3] - x[1], dv = edges ? p[3] - p[2] : p[3] - p[1];
    const Vec normal[3] = {cross(u, v), cross(du, v) + cross(u, dv), cross(du, dv)};
    double c[4] = {dot(w, normal[0]), dot(dw, normal[0]) + dot(w, normal[1]), dot(dw, normal[1]) + dot(w, normal[2]), dot(dw, normal[2])};
    const double side = c[0] < 0.0 ? -1.0 : 1.0;
    for (int k = 0; k < 4; ++k) c[k] = side * c[k] - (k < 3 ? kept * std::sqrt(dot(normal[k], normal[k])) : 0.0);
    return c[0] > 0.0 ? first_root(c) : 0.0;
}

// Along straight lines from x by p, of which ``way`` is the relative one, the share that is safe: 1, or where at least ``left`` of
// the first distance is kept, by conservative advancement. Features nearer than ``near`` keep more, down to where nothing is left
// to lose: from a distance far below that of equal forces a Newton step comes back by a factor of two only.
inline double safe_share(int32_t edges, const Vec* x0, const Vec* p, double way, double left, double near, double* first) {
    double weight[4], dist = std::sqrt(pair_distance_sq(edges, x0, weight));
    *first = dist;
    const double kept = std::max(left, 1.0 - dist / near) * dist, lost = dist - kept;
    if (!(way > 0.0) || dist - kept >= way) return 1.0;
    double time = 0.0;
    Vec x[4] = {x0[0], x0[1], x0[2], x0[3]};
    for (int tries = 0; tries < MOST_ADVANCES && dist - kept > 0.02 * lost; ++tries) {
        Vec gap = {0.0, 0.0, 0.0};
        for (int c = 0; c < 4; ++c) gap = gap + weight[c] * x[c];
        double step = slab_time(edges, x, p, (1.0 / dist) * gap, kept);
        if (time + step < 1.0) {
            Vec rest[4];
            for (int c = 0; c < 4; ++c) rest[c] = (1.0 - time) * p[c];
            step = std::max(step, (1.0 - time) * plane_time(edges, x, rest, kept));
        }
        if (time + step >= 1.0) return 1.0;
        time += 0.999 * step;
        for (int c = 0; c < 4; ++c) x[c] = x0[c] + time * p[c];
        dist = std::sqrt(pair_distance_sq(edges, x, weight));
    }
    return time;
}

}  // namespace
