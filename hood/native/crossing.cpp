// Where triangles pass through each other, and triangles nearest to points: see hood/mesh/crossing.py and hood/mesh/skin.py.
//
// To be compiled without contracted products: faces that share an edge must compute the same signs for it, to the last bit.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "vector.h"

namespace {

constexpr double EPS = 2.220446049250313e-16, TINY = 2.2250738585072014e-308;
constexpr double CELL = 1.5;             // edge of a cell in units of the typical box
constexpr int64_t MANY_CELLS = 512;      // a box over more cells than this is compared with every other box
constexpr int EDGE[3][2] = {{0, 1}, {1, 2}, {0, 2}};  // of a triangle whose corners ascend

inline double axis(Vec v, int k) { return k == 0 ? v.x : k == 1 ? v.y : v.z; }
inline double norm(Vec v) { return std::sqrt(dot(v, v)); }
inline bool finite(Vec v) { return std::isfinite(v.x) && std::isfinite(v.y) && std::isfinite(v.z); }
inline int sign(double v) { return (v > 0.0) - (v < 0.0); }

struct Box {
    double low[3], high[3];
};

inline Box box_of(Vec a, Vec b, Vec c) {
    Box box;
    for (int k = 0; k < 3; ++k) {
        const double x = axis(a, k), y = axis(b, k), z = axis(c, k);
        box.low[k] = std::min(std::min(x, y), z), box.high[k] = std::max(std::max(x, y), z);
    }
    return box;
}

inline bool overlap(const Box& a, const Box& b) {
    bool apart = false;
    for (int k = 0; k < 3; ++k) apart |= a.low[k] > b.high[k] || a.high[k] < b.low[k];
    return !apart;
}

// A triangle with its corners in the order of their numbers, and its unit normal: zero without an area.
struct Triangle {
    int64_t vertex[3];
    Vec corner[3], normal;
};

Triangle triangle(const double* pos, const int64_t* face, const double* origin) {
    Triangle t;
    std::copy(face, face + 3, t.vertex);
    std::sort(t.vertex, t.vertex + 3);
    for (int c = 0; c < 3; ++c) t.corner[c] = at(pos, t.vertex[c]) - at(origin, 0);
    const Vec first = t.corner[1] - t.corner[0], second = t.corner[2] - t.corner[0], normal = cross(first, second);
    const double length = norm(normal);
    // Below this the direction is rounding alone.
    t.normal = length <= 16.0 * EPS * norm(first) * norm(second) ? Vec{0.0, 0.0, 0.0} : (1.0 / length) * normal;
    return t;
}

// Sides of a plane on which the corners lie; false where they are not on both.
inline bool sides(const Triangle& t, const Triangle& plane, double touch, int* side) {
    int least = 1, most = -1;
    for (int c = 0; c < 3; ++c) {
        const double height = dot(t.corner[c] - plane.corner[0], plane.normal);
        side[c] = std::fabs(height) > touch ? sign(height) : 0;
        least = std::min(least, side[c]), most = std::max(most, side[c]);
    }
    return least < 0 && most > 0;
}

// Whether a line passes the edges of a triangle on one side all the way round.
inline bool inside(int a, int b, int c) {
    c = -c;  // the third edge runs against the way round
    return (a >= 0 && b >= 0 && c >= 0) || (a <= 0 && b <= 0 && c <= 0);
}

// The finite triangles of a mesh: boxes about the origin, and their numbers.
struct Boxes {
    std::vector<Box> box;
    std::vector<int64_t> number;
};

Boxes boxes_of(const double* pos, const int64_t* faces, int64_t num_faces, const double* origin) {
    Boxes result;
    result.box.reserve(num_faces), result.number.reserve(num_faces);
    for (int64_t f = 0; f < num_faces; ++f) {
        Vec corner[3];
        for (int c = 0; c < 3; ++c) corner[c] = at(pos, faces[3 * f + c]) - at(origin, 0);
        if (!(finite(corner[0]) && finite(corner[1]) && finite(corner[2]))) continue;
        result.box.push_back(box_of(corner[0], corner[1], corner[2]));
        result.number.push_back(f);
    }
    return result;
}

// Cubic cells around some boxes, and which boxes reach into each; boxes over many cells are kept apart.
struct Grid {
    double low[3], high[3], per_cell;
    int32_t shape[3];
    std::vector<int32_t> start, item, large;

    struct Range {
        int32_t first[3], last[3];
        int64_t count() const { return (int64_t)(last[0] - first[0] + 1) * (last[1] - first[1] + 1) * (last[2] - first[2] + 1); }
    };
    std::vector<Range> ranges;  // of the boxes

    int32_t place(double x, int k) const {
        const double share = (x - low[k]) * per_cell;
        return share <= 0.0 ? 0 : share >= (double)shape[k] ? shape[k] - 1 : (int32_t)share;
    }
    Range range(const Box& box) const {
        Range r;
        for (int k = 0; k < 3; ++k) r.first[k] = place(box.low[k], k), r.last[k] = place(box.high[k], k);
        return r;
    }
    template <class Visit> void cells(const Range& r, Visit visit) const {
        for (int32_t z = r.first[2]; z <= r.last[2]; ++z)
            for (int32_t y = r.first[1]; y <= r.last[1]; ++y)
                for (int32_t x = r.first[0]; x <= r.last[0]; ++x) visit((z * shape[1] + y) * shape[0] + x);
    }

    Grid(const std::vector<Box>& boxes, double typical) {
        for (int k = 0; k < 3; ++k) low[k] = INFINITY, high[k] = -INFINITY;
        for (const Box& box : boxes)
            for (int k = 0; k < 3; ++k) low[k] = std::min(low[k], box.low[k]), high[k] = std::max(high[k], box.high[k]);
        const double extent = std::max(std::max(high[0] - low[0], high[1] - low[1]), high[2] - low[2]);
        double cell = std::max(std::max(CELL * typical, 1e-5 * extent), TINY);
        // No more cells than a few times the boxes.
        const double most = 64.0 + 8.0 * (double)boxes.size();
        while (true) {
            double count = 1.0;
            for (int k = 0; k < 3; ++k) count *= std::floor((high[k] - low[k]) / cell) + 1.0;
            if (count <= most) break;
            cell *= 1.25;
        }
        per_cell = 1.0 / cell;
        int32_t count = 1;
        for (int k = 0; k < 3; ++k) count *= shape[k] = (int32_t)((high[k] - low[k]) / cell) + 1;
        start.assign(count + 1, 0);
        ranges.reserve(boxes.size());
        for (size_t i = 0; i < boxes.size(); ++i) {
            ranges.push_back(range(boxes[i]));
            if (ranges[i].count() > MANY_CELLS) large.push_back((int32_t)i);
            else cells(ranges[i], [&](int32_t c) { ++start[c + 1]; });
        }
        for (int32_t c = 0; c < count; ++c) start[c + 1] += start[c];
        item.resize(start[count]);
        std::vector<int32_t> next(start.begin(), start.end() - 1);
        for (size_t i = 0; i < boxes.size(); ++i)
            if (ranges[i].count() <= MANY_CELLS) cells(ranges[i], [&](int32_t c) { item[next[c]++] = (int32_t)i; });
    }

    // Those of ``boxes``, which the grid was made of, that overlap another one, below a number.
    template <class Visit> void overlapping(const std::vector<Box>& boxes, const Box& other, int32_t end, Visit visit) const {
        for (int k = 0; k < 3; ++k)
            if (other.low[k] > high[k] || other.high[k] < low[k]) return;
        for (int32_t i : large)
            if (i < end && overlap(boxes[i], other)) visit(i);
        const Range r = range(other);
        if (r.count() > MANY_CELLS) {
            for (int32_t i = 0; i < end; ++i)
                if (ranges[i].count() <= MANY_CELLS && overlap(boxes[i], other)) visit(i);
            return;
        }
        for (int32_t z = r.first[2]; z <= r.last[2]; ++z)
            for (int32_t y = r.first[1]; y <= r.last[1]; ++y)
                for (int32_t x = r.first[0]; x <= r.last[0]; ++x) {
                    const int32_t c = (z * shape[1] + y) * shape[0] + x;
                    for (int32_t at = start[c]; at < start[c + 1] && item[at] < end; ++at) {
                        // Of the cells that both reach into, in the first one.
                        const int32_t i = item[at], *first = ranges[i].first;
                        const bool here = (first[0] == x || r.first[0] == x) & (first[1] == y || r.first[1] == y) &
                                          (first[2] == z || r.first[2] == z);
                        if (here && overlap(boxes[i], other)) visit(i);
                    }
                }
    }
};

double typical_size(const std::vector<Box>& boxes) {
    if (boxes.empty()) return 0.0;
    std::vector<double> size(boxes.size());
    for (size_t i = 0; i < boxes.size(); ++i) {
        const Box& box = boxes[i];
        size[i] = std::max(std::max(box.high[0] - box.low[0], box.high[1] - box.low[1]), box.high[2] - box.low[2]);
    }
    std::nth_element(size.begin(), size.begin() + size.size() / 2, size.end());
    return size[size.size() / 2];
}

// Triangles of a mesh, made when they are first needed.
struct Lazy {
    const double *pos, *origin;
    const int64_t* faces;
    std::vector<Triangle> made;
    std::vector<int32_t> where;

    Lazy(const double* pos, const int64_t* faces, int64_t count, const double* origin)
        : pos(pos), origin(origin), faces(faces), where(count, -1) {}
    const Triangle& get(int64_t face) {
        if (where[face] < 0) {
            where[face] = (int32_t)made.size();
            made.push_back(triangle(pos, faces + 3 * face, origin));
        }
        return made[where[face]];
    }
};

inline bool share_vertex(const int64_t* a, const int64_t* b) {
    bool same = false;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) same |= a[i] == b[j];
    return same;
}

// Squared distance from p to a triangle and the weights of its nearest point: exactly 0 for corners that have no part in it.
double closest(Vec p, Vec a, Vec b, Vec c, double* weights) {
    const Vec corner[3] = {a, b, c};
    double best = INFINITY;
    for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3;
        const Vec along = corner[j] - corner[i], from = p - corner[i];
        const double length_sq = dot(along, along);
        double share = dot(from, along) / (length_sq > 0.0 ? length_sq : 1.0);
        share = share < 0.0 ? 0.0 : share > 1.0 ? 1.0 : share;
        const Vec offset = from - share * along;
        const double dist_sq = dot(offset, offset);
        if (!(dist_sq < best)) continue;
        best = dist_sq;
        weights[i] = 1.0 - share, weights[j] = share, weights[(i + 2) % 3] = 0.0;
    }
    const Vec first = b - a, second = c - a, offset = p - a, normal = cross(first, second);
    const double area_sq = dot(normal, normal);
    if (area_sq <= 256.0 * EPS * EPS * dot(first, first) * dot(second, second)) return best;
    const double scale = 1.0 / area_sq, y = dot(cross(offset, second), normal) * scale, z = dot(cross(first, offset), normal) * scale;
    const double x = 1.0 - y - z;
    if (!(x > 0.0 && y > 0.0 && z > 0.0)) return best;
    weights[0] = x, weights[1] = y, weights[2] = z;
    const Vec gap = p - (x * a + y * b + z * c);
    return dot(gap, gap);
}

}  // namespace

extern "C" {

struct Mesh {
    int64_t num_faces;
    const double* pos;     // (V, 3) m
    const int64_t* faces;  // (F, 3)
};

// Rows that were found; where there are more than there is room for, they are counted alone.
struct Rows {
    int64_t room[3], found[3];
    int64_t *pairs, *first_edges, *second_edges;  // (., 2), (., 3), (., 3)
};

// Crossings of two meshes, or of pairs of one mesh's faces without a common vertex, the smaller number first (``same``).
void crossing_find(const Mesh* first, const Mesh* second, int64_t same, const double* origin, double touch, Rows* rows) {
    for (int k = 0; k < 3; ++k) rows->found[k] = 0;
    const Boxes own = boxes_of(first->pos, first->faces, first->num_faces, origin);
    const Boxes other = same ? Boxes{} : boxes_of(second->pos, second->faces, second->num_faces, origin);
    const Boxes& others = same ? own : other;
    if (own.box.empty() || others.box.empty()) return;
    const Grid grid(own.box, std::max(typical_size(own.box), typical_size(others.box)));
    Lazy lazy(first->pos, first->faces, first->num_faces, origin);
    Lazy lazy_other(second->pos, second->faces, same ? 0 : second->num_faces, origin);
    const auto put = [&](int which, int64_t* table, int width, int64_t x, int64_t y, int64_t z) {
        int64_t* row = table + width * rows->found[which];
        if (rows->found[which]++ >= rows->room[which]) return;
        row[0] = x, row[1] = y;
        if (width == 3) row[2] = z;
    };
    const auto examine = [&](int64_t f, int64_t g) {
        lazy.get(f);
        (same ? lazy : lazy_other).get(g);
        const Triangle &a = lazy.get(f), &b = (same ? lazy : lazy_other).get(g);
        int side[3], other_side[3], turn[3][3];
        if (!sides(a, b, touch, side) || !sides(b, a, touch, other_side)) return;
        for (int i = 0; i < 3; ++i) {
            const Vec start = a.corner[EDGE[i][0]], along = a.corner[EDGE[i][1]] - start;
            const Vec moved[3] = {b.corner[0] - start, b.corner[1] - start, b.corner[2] - start};
            for (int j = 0; j < 3; ++j) turn[i][j] = sign(dot(along, cross(moved[EDGE[j][0]], moved[EDGE[j][1]])));
        }
        bool crossed = false;
        for (int i = 0; i < 3; ++i) {
            const int *ends = EDGE[i], here = side[ends[0]] * side[ends[1]], there = other_side[ends[0]] * other_side[ends[1]];
            if (here < 0 && inside(turn[i][0], turn[i][1], turn[i][2])) {
                crossed = true;
                put(1, rows->first_edges, 3, a.vertex[ends[0]], a.vertex[ends[1]], g);
            }
            if (there < 0 && inside(turn[0][i], turn[1][i], turn[2][i])) {
                crossed = true;
                put(2, rows->second_edges, 3, b.vertex[ends[0]], b.vertex[ends[1]], f);
            }
        }
        if (crossed) put(0, rows->pairs, 2, f, g, 0);
    };
    for (size_t i = 0; i < others.box.size(); ++i) {
        const int64_t g = others.number[i];
        const int32_t end = same ? (int32_t)i : (int32_t)own.box.size();  // of two of one mesh the smaller number is the first
        grid.overlapping(own.box, others.box[i], end, [&](int32_t at) {
            const int64_t f = own.number[at];
            if (!same || !share_vertex(first->faces + 3 * f, first->faces + 3 * g)) examine(f, g);
        });
    }
}

// Of points (N, 3) the nearest of triangles (T, 3, 3) within a distance (N), the first one of several; its number or -1, weights
// (N, 3) of the nearest point and the distance (N).
void crossing_nearest(int64_t num_points, const double* points, const double* reach, int64_t num_triangles, const double* corners,
                      int64_t* number, double* weights, double* dist) {
    std::vector<double> side(6 * num_triangles), away(num_triangles);
    for (int64_t t = 0; t < num_triangles; ++t) {
        const Box box = box_of(at(corners, 3 * t), at(corners, 3 * t + 1), at(corners, 3 * t + 2));
        for (int k = 0; k < 3; ++k) side[k * num_triangles + t] = box.low[k], side[(3 + k) * num_triangles + t] = box.high[k];
    }
    for (int64_t i = 0; i < num_points; ++i) {
        const Vec p = at(points, i);
        std::fill(away.begin(), away.end(), 0.0);
        for (int k = 0; k < 3; ++k) {
            const double x = axis(p, k), *low = side.data() + k * num_triangles, *high = low + 3 * num_triangles;
            for (int64_t t = 0; t < num_triangles; ++t) {
                const double below = low[t] - x, above = x - high[t], gap = below > above ? below : above;
                away[t] += gap > 0.0 ? gap * gap : 0.0;
            }
        }
        double best = reach[i] * reach[i];
        number[i] = -1;
        const auto examine = [&](int64_t t) {
            double at_point[3];
            const double dist_sq = closest(p, at(corners, 3 * t), at(corners, 3 * t + 1), at(corners, 3 * t + 2), at_point);
            if (dist_sq < best || (dist_sq == best && (number[i] < 0 || t < number[i]))) {
                best = dist_sq, number[i] = t;
                std::copy(at_point, at_point + 3, weights + 3 * i);
            }
        };
        // The one whose box is nearest first: it leaves few others to look at.
        const int64_t likely = std::min_element(away.begin(), away.end()) - away.begin();
        if (likely < num_triangles) examine(likely);
        for (int64_t t = 0; t < num_triangles; ++t)
            if (away[t] <= best * (1.0 + 1e-9) && t != likely) examine(t);
        dist[i] = std::sqrt(best);
    }
}

// Distances (N) from points (N, 3) to the nearest of others (M, 3).
void crossing_clearance(int64_t num_points, const double* points, int64_t num_others, const double* others, double* dist) {
    for (int64_t i = 0; i < num_points; ++i) {
        double best = INFINITY;
        for (int64_t j = 0; j < num_others; ++j) {
            const double x = others[3 * j] - points[3 * i], y = others[3 * j + 1] - points[3 * i + 1], z = others[3 * j + 2] - points[3 * i + 2];
            best = std::min(best, x * x + y * y + z * z);
        }
        dist[i] = std::sqrt(best);
    }
}
}
