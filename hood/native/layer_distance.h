// Distances of two features of a cloth: a vertex and a face, or two edges.
#pragma once
#include <cmath>
#include <cstdint>
#include <limits>

#include "vector.h"

namespace {

inline double layer_clamp(double v) { return v < 0.0 ? 0.0 : v > 1.0 ? 1.0 : v; }

inline double point_segment(Vec p, Vec a, Vec b, double* share) {
    const Vec along = b - a, from = p - a;
    const double size = dot(along, along);
    *share = size > 0.0 ? layer_clamp(dot(from, along) / size) : 0.0;
    const Vec gap = from - *share * along;
    return dot(gap, gap);
}

// Square of the distance of a point to a triangle, and weights of all four such that the gap is their sum.
inline double point_triangle(Vec p, Vec a, Vec b, Vec c, double* weight) {
    const Vec corner[3] = {a, b, c}, first = b - a, second = c - a, offset = p - a, normal = cross(first, second);
    const double area_sq = dot(normal, normal);
    weight[0] = 1.0;
    if (area_sq > 1e-24 * dot(first, first) * dot(second, second)) {
        const double y = dot(cross(offset, second), normal) / area_sq, z = dot(cross(first, offset), normal) / area_sq, x = 1.0 - y - z;
        if (x >= 0.0 && y >= 0.0 && z >= 0.0) {
            const double height = dot(offset, normal);
            weight[1] = -x, weight[2] = -y, weight[3] = -z;
            return height * height / area_sq;
        }
    }
    double best = std::numeric_limits<double>::infinity();
    for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3;
        double share;
        const double square = point_segment(p, corner[i], corner[j], &share);
        if (!(square < best)) continue;
        best = square;
        weight[1 + i] = share - 1.0, weight[1 + j] = -share, weight[1 + (i + 2) % 3] = 0.0;
    }
    return best;
}

// The same for two segments. Of edges that are parallel but for rounding, the solution inside is anywhere, and below an angle of 1e-4 not
// exact enough for edges that touch: an end that is nearer counts, as in segment_segment_sq.
inline double segment_segment(Vec a, Vec b, Vec c, Vec d, double* weight) {
    const Vec u = b - a, v = d - c, w = a - c;
    const double uu = dot(u, u), uv = dot(u, v), vv = dot(v, v), uw = dot(u, w), vw = dot(v, w), det = uu * vv - uv * uv;
    double best = std::numeric_limits<double>::infinity(), share;
    if (det > 1e-24 * uu * vv) {
        const double s = (uv * vw - vv * uw) / det, t = (uu * vw - uv * uw) / det;
        if (s >= 0.0 && s <= 1.0 && t >= 0.0 && t <= 1.0) {
            const Vec gap = w + s * u - t * v;
            weight[0] = 1.0 - s, weight[1] = s, weight[2] = t - 1.0, weight[3] = -t;
            best = dot(gap, gap);
            if (det > 1e-8 * uu * vv) return best;
        }
    }
    const Vec end[4] = {a, b, c, d};
    for (int i = 0; i < 4; ++i) {
        const double square = i < 2 ? point_segment(end[i], c, d, &share) : point_segment(end[i], a, b, &share);
        if (!(square < best)) continue;
        best = square;
        const double sign = i < 2 ? 1.0 : -1.0;
        for (int k = 0; k < 4; ++k) weight[k] = 0.0;
        weight[i] = sign;
        const int other = i < 2 ? 2 : 0;
        weight[other] = -sign * (1.0 - share), weight[other + 1] = -sign * share;
    }
    return best;
}

inline double pair_distance_sq(int32_t edges, const Vec* x, double* weight) {
    return edges ? segment_segment(x[0], x[1], x[2], x[3], weight) : point_triangle(x[0], x[1], x[2], x[3], weight);
}

}  // namespace
