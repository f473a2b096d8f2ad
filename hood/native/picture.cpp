// Pictures: the nearest face of every pixel, and the light on it. The rules are those of hood/media, which stays the reference.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "vector.h"

namespace {

inline double clip(double v, double low, double high) { return std::min(std::max(v, low), high); }
constexpr int64_t TILE = 16;  // pixels of a tile of the shadow map, as in shading.py
inline Vec unit(Vec a) { return (1.0 / std::max(std::sqrt(dot(a, a)), 1e-12)) * a; }

}  // namespace

extern "C" {

// As `LightValues` of hood/media/renderer/raster.py.
struct Light {
    const double* map;     // (size, size) nearness of what the key light sees
    const double* most;    // (tiles, tiles) the most of it from a tile before each tile to one behind
    const double* probes;  // (num_probes, 2) texels
    const double* axes;    // (3, 3) of the key light's view
    int64_t size, num_probes, tiles;
    double low[2];         // m, corner of the map
    double scale, texel;   // texels per m, m
    double key[3], fill[3];
    double key_color[3], fill_color[3], sky_color[3], bounce_color[3];
};

// As `SeenValues` of hood/media/renderer/raster.py: what is drawn, and from where.
struct Seen {
    const double *pos, *color, *normal, *shine;           // (V, 3) of vertices
    const double *screen, *depth;                         // (V, 2) pixels, (V,) m
    const double* hem;                                    // (V,) m from the next hem
    const int64_t* faces;                                 // (F, 3)
    const int32_t* face;                                  // (height, width) of each pixel, -1 where nothing is drawn
    const double* nearness;                               // (height, width) 1/m
    const double* around;                                 // (4, num_around, 2) shares of the reach, by the pixel's place in its four
    const double* axes;                                   // (3, 3) right, up, forward
    const double* own;  // (height, width, 3) colours instead of those of vertices where not NaN; null: nowhere
    int64_t width, height, num_around;
    double eye[3];
    double focal, reach;  // pixels, m
};

// As `FloorValues` of hood/media/renderer/raster.py: what lies behind the surface.
struct Floor {
    const double* dark;  // (cells, cells) shade under low parts
    int64_t width, height, cells;
    double eye[3], right[3], up[3], forward[3], center[3];
    double tan_y, floor, cell;
    double ground[3], horizon[3], zenith[3];  // ground linear, the others as shown
};

// best (H, W) starts at -inf, owner (H, W) at -1; of equally near faces the last is drawn.
void picture_rasterise(const double* screen, const double* nearness, const int64_t* faces, int64_t num_faces, int64_t width,
                       int64_t height, double tolerance, double least_area, double* best, int32_t* owner) {
    for (int64_t f = 0; f < num_faces; ++f) {
        double x[3], y[3], near[3];
        for (int k = 0; k < 3; ++k) {
            const int64_t v = faces[3 * f + k];
            x[k] = screen[2 * v];
            y[k] = screen[2 * v + 1];
            near[k] = nearness[v];
        }
        const double area = (x[1] - x[0]) * (y[2] - y[0]) - (y[1] - y[0]) * (x[2] - x[0]);
        const double top = std::max(std::ceil(std::min({y[0], y[1], y[2]}) - 0.5), 0.0);
        const double bottom = std::min(std::floor(std::max({y[0], y[1], y[2]}) - 0.5), height - 1.0);
        const bool outside = std::max({x[0], x[1], x[2]}) <= 0 || std::min({x[0], x[1], x[2]}) >= width;
        if (!(std::fabs(area) > least_area) || outside || !(bottom >= top)) continue;
        double slope_x[3], slope_y[3], constant[3], per_slope[3], along = 0.0;
        for (int k = 0; k < 3; ++k) {
            const int n = (k + 1) % 3, p = (k + 2) % 3;
            slope_x[k] = (y[n] - y[p]) / area;
            slope_y[k] = (x[p] - x[n]) / area;
            constant[k] = (x[n] * y[p] - x[p] * y[n]) / area;
            along += slope_x[k] * near[k];
            per_slope[k] = 1.0 / (std::fabs(slope_x[k]) < 1e-12 ? 1e-12 : slope_x[k]);
        }
        for (int64_t row = (int64_t)top; row <= (int64_t)bottom; ++row) {
            double lower = -INFINITY, upper = INFINITY, here = 0.0;
            for (int k = 0; k < 3; ++k) {
                const double at_row = slope_y[k] * (row + 0.5) + constant[k];
                const double root = -at_row * per_slope[k];
                if (per_slope[k] > 0) lower = std::max(lower, root);
                else upper = std::min(upper, root);
                here += at_row * near[k];
            }
            const double first = std::max(std::ceil(lower - 0.5 - tolerance), 0.0);
            const double last = std::min(std::floor(upper - 0.5 + tolerance), width - 1.0);
            for (int64_t column = (int64_t)first; column <= last; ++column) {
                const double value = here + along * (column + 0.5);
                double& nearest = best[row * width + column];
                if (value >= nearest) {
                    nearest = value;
                    owner[row * width + column] = (int32_t)f;
                }
            }
        }
    }
}

// Unit normals (V, 3) of vertices, zero at the start: of faces by their areas.
void picture_normals(const double* pos, const int64_t* faces, int64_t num_faces, int64_t num_vertices, double* out) {
    for (int64_t f = 0; f < num_faces; ++f) {
        const int64_t* corner = faces + 3 * f;
        const Vec a = at(pos, corner[0]), normal = cross(at(pos, corner[1]) - a, at(pos, corner[2]) - a);
        for (int k = 0; k < 3; ++k) {
            double* sum = out + 3 * corner[k];
            sum[0] += normal.x, sum[1] += normal.y, sum[2] += normal.z;
        }
    }
    for (int64_t v = 0; v < num_vertices; ++v) {
        const Vec normal = unit(at(out, v));
        out[3 * v] = normal.x, out[3 * v + 1] = normal.y, out[3 * v + 2] = normal.z;
    }
}

// Shade of faces on the floor below them, by cells (cells, cells) of z and x about the middle, zero at the start.
void picture_low(const double* pos, const int64_t* faces, int64_t num_faces, const double* middle, double floor, double cell, int64_t cells,
                 double* out) {
    for (int64_t f = 0; f < num_faces; ++f) {
        const Vec a = at(pos, faces[3 * f]), b = at(pos, faces[3 * f + 1]), c = at(pos, faces[3 * f + 2]);
        const Vec there = 1.0 / 3.0 * (a + b + c);
        const double share = std::fabs(cross(b - a, c - a).y) * std::exp(-std::max(there.y - floor, 0.0) / 0.12);
        const auto place = [&](double v) { return (int64_t)clip(v / cell + cells / 2, 0.0, cells - 1.0); };
        out[place(there.z - middle[2]) * cells + place(there.x - middle[0])] += 0.25 / (cell * cell) * share;
    }
}

// The most of a map (size, size) in every tile: (size / TILE, size / TILE), minus infinity at the start.
void picture_most(const double* map, int64_t size, double* out) {
    const int64_t tiles = size / TILE;
    for (int64_t row = 0; row < size; ++row)
        for (int64_t tile = 0; tile < tiles; ++tile) {
            const double* first = map + row * size + TILE * tile;
            double most = out[row / TILE * tiles + tile];
            for (int i = 0; i < TILE; ++i) most = first[i] > most ? first[i] : most;
            out[row / TILE * tiles + tile] = most;
        }
}

}  // extern "C"

namespace {

double lit_at(const Light& light, Vec p, double spread) {
    double seen[3];
    for (int k = 0; k < 3; ++k) seen[k] = dot(at(light.axes, k), p);
    const double across = (seen[0] - light.low[0]) * light.scale + 4.0, down = (seen[1] - light.low[1]) * light.scale + 4.0;
    const double bound = 0.004 + 1.5 * spread * light.texel - seen[2], most = light.size - 1.0, edge = 4.0 * spread;
    if (across < -edge || down < -edge || across > most + edge || down > most + edge) return 1.0;  // the map's rim is empty
    const int64_t tile = (int64_t)clip(down, 0.0, most) / TILE * light.tiles + (int64_t)clip(across, 0.0, most) / TILE;
    if (!(light.most[tile] > bound)) return 1.0;
    int64_t covered = 0;
    for (int64_t i = 0; i < light.num_probes; ++i) {
        const int64_t column = (int64_t)clip(across + spread * light.probes[2 * i], 0.0, most);
        const int64_t row = (int64_t)clip(down + spread * light.probes[2 * i + 1], 0.0, most);
        covered += light.map[row * light.size + column] > bound;
    }
    return 1.0 - (double)covered / light.num_probes;
}

double power_24(double v) {
    const double square = v * v, eighth = square * square * square * square;
    return eighth * eighth * eighth;
}

// Share of the light from all sides that is not kept off by what is near: as `openness` of hood/media/renderer/shading.py.
// Depths (height, width) in m, 0 where nothing is seen.
double openness(const Seen& s, const float* depths, int64_t row, int64_t column, Vec normal) {
    const double across = 0.5 * s.width, up = 0.5 * s.height, depth = depths[row * s.width + column];
    const double per_pixel = 1.0 / s.focal, per_reach = 1.0 / (s.reach * s.reach);
    const double x = (column + 0.5 - across) * per_pixel * depth, y = (up - row - 0.5) * per_pixel * depth;
    const double n[3] = {dot(at(s.axes, 0), normal), dot(at(s.axes, 1), normal), dot(at(s.axes, 2), normal)};
    const double reach = s.focal * s.reach / depth;
    const int64_t place = 2 * (row % 2) + column % 2;
    double kept = 0.0;
    for (const int64_t ring : {place, 3 - place}) {
        const double* offset = s.around + 2 * s.num_around * ring;
        for (const double* end = offset + 2 * s.num_around; offset < end; offset += 2) {
            const int64_t c = (int64_t)std::floor(column + 0.5 + reach * offset[0]);
            const int64_t r = (int64_t)std::floor(row + 0.5 + reach * offset[1]);
            if (c < 0 || r < 0 || c >= s.width || r >= s.height) continue;
            const double there = depths[r * s.width + c];
            const double dx = (c + 0.5 - across) * per_pixel * there - x, dy = (up - r - 0.5) * per_pixel * there - y;
            const double dz = there - depth, dist_sq = dx * dx + dy * dy + dz * dz, far = dist_sq * per_reach;
            const double above = n[0] * dx + n[1] * dy + n[2] * dz;
            if (there == 0.0 || far >= 1.0 || !(above > 0.0)) continue;
            kept += std::max(above / std::sqrt(dist_sq) - 0.1, 0.0) * (1.0 - far);
        }
    }
    return clip(1.0 - 1.1 * kept / s.num_around, 0.2, 1.0);
}

// Share of the colour left by the hem's edge and its seam, smoothed over the pixel's footprint [m].
double sewn(double dist, double foot) {
    const double edge = clip((0.0025 - dist) / foot + 0.5, 0.0, 1.0);
    const double seam = clip((0.0015 - std::fabs(dist - 0.02)) / foot + 0.5, 0.0, 1.0) * std::min(1.0, 0.003 / foot);
    return 1.0 - 0.3 * edge - 0.35 * seam;
}

void shade(const Light& light, Vec pos, Vec normal, Vec view, Vec color, Vec shines, double open, double* out) {
    const Vec key = at(light.key, 0);
    const double diffuse = clip((dot(normal, key) + 0.25) / 1.25, 0.0, 1.0);
    const double shadow = (0.25 + 0.75 * lit_at(light, pos + 0.006 * normal, 0.9)) * (0.5 + 0.5 * open);
    const double fill = clip(dot(normal, at(light.fill, 0)), 0.0, 1.0);
    const double up = 0.5 + 0.5 * normal.y, facing = clip(dot(normal, view), 0.0, 1.0);
    const double broad = power_24(clip(dot(normal, unit(view + key)), 0.0, 1.0)), squared = broad * broad;
    const double gloss = (shines.x * broad + shines.y * squared * squared) * shadow;
    const double away = 1.0 - facing, shine = gloss + shines.z * away * away * away * up, dim = 0.72 + 0.28 * facing;
    const double own[3] = {color.x, color.y, color.z};
    for (int k = 0; k < 3; ++k) {
        const double around = fill * light.fill_color[k] + up * light.sky_color[k] + (1.0 - up) * light.bounce_color[k];
        const double received = diffuse * shadow * light.key_color[k] + open * around;
        out[k] = own[k] * received * dim + shine;
    }
}

// Colour of a pixel that sees a face, from either side.
void shade_pixel(const Light& light, const Seen& seen, const float* depths, int64_t row, int64_t column, double* out) {
    const int64_t pixel = row * seen.width + column;
    const int64_t* corner = seen.faces + 3 * (int64_t)seen.face[pixel];
    const double *a = seen.screen + 2 * corner[0], *b = seen.screen + 2 * corner[1], *c = seen.screen + 2 * corner[2];
    const double px = column + 0.5 - a[0], py = row + 0.5 - a[1];
    const double turned = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
    const double second = (px * (c[1] - a[1]) - py * (c[0] - a[0])) / turned;
    const double third = ((b[0] - a[0]) * py - (b[1] - a[1]) * px) / turned;
    double weight[3] = {1.0 - second - third, second, third}, sum = 0.0;
    for (int k = 0; k < 3; ++k) sum += weight[k] /= seen.depth[corner[k]];
    Vec pos{0, 0, 0}, color{0, 0, 0}, normal{0, 0, 0}, shines{0, 0, 0};
    double hem = 0.0;
    for (int k = 0; k < 3; ++k) {
        const double share = clip(weight[k] / sum, 0.0, 1.0);
        shines = shines + share * at(seen.shine, corner[k]);
        pos = pos + share * at(seen.pos, corner[k]);
        color = color + share * at(seen.color, corner[k]);
        normal = normal + share * at(seen.normal, corner[k]);
        hem += share * seen.hem[corner[k]];
    }
    if (seen.own && !std::isnan(seen.own[3 * pixel])) color = at(seen.own, pixel);
    normal = unit(normal);
    if (turned > 0) normal = -normal;
    color = sewn(hem, 1.0 / (seen.focal * seen.nearness[pixel])) * color;
    shade(light, pos, normal, unit(at(seen.eye, 0) - pos), color, shines, openness(seen, depths, row, column, normal), out);
}

}  // namespace

extern "C" {

// Share of the key light at points (P, 3) that is not in shadow.
void picture_lit(const Light* light, const double* points, int64_t count, double spread, double* out) {
    for (int64_t i = 0; i < count; ++i) out[i] = lit_at(*light, at(points, i), spread);
}

}  // extern "C"

namespace {

// Bilinear; the border is repeated.
double sample(const Floor& f, double row, double column) {
    const double most = f.cells - 1.001;
    row = clip(row, 0.0, most);
    column = clip(column, 0.0, most);
    const int64_t r = (int64_t)row, c = (int64_t)column;
    const double down = row - r, across = column - c;
    const double* at = f.dark + r * f.cells + c;
    const double upper = at[0] * (1 - across) + at[1] * across;
    const double lower = at[f.cells] * (1 - across) + at[f.cells + 1] * across;
    return upper * (1 - down) + lower * down;
}

double positive_remainder(double v) { return v - std::floor(v); }

// What rays that go down as steeply have in common: a row of pixels does, unless the picture is turned.
struct Steep {
    double down = 0.0, reach, per_foot, thin;

    void see(const Floor& f, double drop, double ray_down) {
        if (ray_down == down) return;
        down = ray_down, reach = drop / ray_down;
        const double foot = std::max(reach * 2.0 * f.tan_y / f.height, 1e-4) * std::sqrt(std::max(reach / drop, 1.0));
        per_foot = 1.0 / foot, thin = std::min(1.0, 0.01 / foot);
    }
};

// Coverage of 1 cm lines every half metre, smoothed over the pixel's footprint.
double grid_lines(Vec pos, const Steep& steep) {
    double lines = 0.0;
    for (double along : {pos.x, pos.z}) {
        const double offset = std::fabs(positive_remainder(along / 0.5 + 0.5) - 0.5) * 0.5;
        lines = std::max(lines, clip((0.005 - offset) * steep.per_foot + 0.5, 0.0, 1.0) * steep.thin);
    }
    return lines;
}

void floor_color(const Light& light, const Floor& f, const Steep& steep, Vec ray, double* out) {
    const Vec pos = at(f.eye, 0) + steep.reach * ray;
    const double from_x = pos.x - f.center[0], from_z = pos.z - f.center[2], away_sq = from_x * from_x + from_z * from_z;
    if (away_sq > 400.0) return;  // faded to 1e-17
    const double fade = std::exp(-away_sq * (1.0 / (3.2 * 3.2))), lines = grid_lines(pos, steep);
    const double half = f.cells / 2.0 - 0.5, per_cell = 1.0 / f.cell;
    double left = 1.0 - clip(sample(f, from_z * per_cell + half, from_x * per_cell + half), 0.0, 0.6);
    if (away_sq < 9.0) left *= 0.80 + 0.20 * lit_at(light, pos, 2.5);
    for (int k = 0; k < 3; ++k) out[k] = fade * (f.ground[k] * (1.0 - 0.16 * lines * fade) * left) + (1.0 - fade) * out[k];
}

// Linear colours of the sky by how high a ray goes, 0 to 1: between the entries it is straight to 1e-7.
struct Sky {
    static constexpr int STEPS = 1024;
    double color[STEPS + 2][3];

    explicit Sky(const Floor& f) {
        for (int i = 0; i < STEPS + 2; ++i)
            for (int k = 0; k < 3; ++k) color[i][k] = std::pow(f.horizon[k] + (f.zenith[k] - f.horizon[k]) * i / STEPS, 2.2);
    }
    void at(double high, double* out) const {
        const int i = (int)(STEPS * high);
        const double share = STEPS * high - i;
        for (int k = 0; k < 3; ++k) out[k] = color[i][k] + share * (color[i + 1][k] - color[i][k]);
    }
};

// What is behind the surface: the floor, which fades into a plain background.
void background(const Light& light, const Floor& f, const Sky& sky, Steep& steep, int64_t row, int64_t column, double* out) {
    const double per_pixel = f.tan_y / (0.5 * f.height), drop = f.eye[1] - f.floor;
    const double x = (column + 0.5 - 0.5 * f.width) * per_pixel, y = (0.5 * f.height - row - 0.5) * per_pixel;
    const Vec ray = at(f.forward, 0) + x * at(f.right, 0) + y * at(f.up, 0);
    sky.at(ray.y > 0.0 ? clip(1.6 * ray.y / std::sqrt(dot(ray, ray)), 0.0, 1.0) : 0.0, out);
    if (!(ray.y < -1e-4 && drop >= 1e-3)) return;
    steep.see(f, drop, -ray.y);
    floor_color(light, f, steep, ray, out);
}

// The numbers 0 to 255 by which linear colours are shown.
struct Shown {
    static constexpr int STEPS = 1024;  // of the root of a colour; no step holds the limits of two numbers
    double least[257];                  // from which a number is shown
    uint8_t guess[STEPS + 1];           // the number at the beginning of every step

    Shown() {
        for (int k = 0; k < 257; ++k) least[k] = k == 0 ? -1.0 : k == 256 ? 2.0 : std::pow((k - 0.5) / 255.0, 2.2);
        for (int i = 0, k = 0; i <= STEPS; ++i) {
            while (std::sqrt(std::max(least[k + 1], 0.0)) * STEPS <= i) ++k;
            guess[i] = (uint8_t)k;
        }
    }
    uint8_t operator()(double color) const {
        const double shown = clip(color, 0.0, 1.0);
        int k = guess[(int)(STEPS * std::sqrt(shown))];
        k += least[k + 1] <= shown;  // without a branch
        return (uint8_t)(k - (least[k] > shown));
    }
};

}  // namespace

extern "C" {

// The picture (height, width, 3) of the floor's size: the mean of 2 x 2 pixels of what is seen, of which those with one face have the
// colour of the first; the background where they see nothing.
void picture_draw(const Light* light, const Seen* seen, const Floor* floor, uint8_t* out) {
    const Sky sky(*floor);
    const Shown shown;
    Steep steep;
    thread_local std::vector<float> depths;
    depths.resize((size_t)(seen->width * seen->height));
    for (int64_t i = 0; i < seen->width * seen->height; ++i) depths[i] = seen->face[i] < 0 ? 0.0f : (float)(1.0 / seen->nearness[i]);
    for (int64_t row = 0; row < floor->height; ++row)
        for (int64_t column = 0; column < floor->width; ++column, out += 3) {
            double sum[3] = {0.0, 0.0, 0.0}, color[4][3];
            int32_t face[4];
            int empty = 0;
            for (int64_t i = 0; i < 4; ++i) {
                const int64_t below = 2 * row + i / 2, right = 2 * column + i % 2;
                face[i] = seen->face[below * seen->width + right];
                if (face[i] < 0) {
                    ++empty;
                    continue;
                }
                int64_t first = 0;
                while (face[first] != face[i]) ++first;
                if (first == i) shade_pixel(*light, *seen, depths.data(), below, right, color[i]);
                for (int k = 0; k < 3; ++k) sum[k] += color[first][k];
            }
            if (empty > 0) {
                background(*light, *floor, sky, steep, row, column, color[0]);
                for (int k = 0; k < 3; ++k) sum[k] += empty * color[0][k];
            }
            for (int k = 0; k < 3; ++k) out[k] = shown(sum[k] / 4.0);
        }
}

}  // extern "C"
