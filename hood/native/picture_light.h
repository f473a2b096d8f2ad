// Light on surfaces and on the floor, and where the key light does not reach.
#pragma once
#include <algorithm>

#include "picture_lanes.h"

extern "C" {

// As `LightValues` of hood/media/renderer/raster.py.
struct Light {
    const float* map;      // (size, size) nearness of what the key light sees
    const double* most;    // (tiles, tiles) the most of it from a tile before each tile to one behind
    const double* probes;  // (num_probes, 2) texels
    const double* axes;    // (3, 3) of the key light's view
    int64_t size, num_probes, tiles;
    double low[2];         // m, corner of the map
    double scale, texel;   // texels per m, m
    double key[3], fill[3];
    double key_color[3], fill_color[3], sky_color[3], bounce_color[3];
};
}

namespace {

constexpr int TILE = 16;  // pixels of a tile of the shadow map, as in shading.py

// What of the key light reaches places that are given about an origin, by probes of the shadow map so far apart.
struct Shadow {
    const Light& light;
    Three across, down, away;  // texels per m, texels per m, m per m
    float start[3], spread;    // of the origin, texels, texels and how near it may be in the map [m]

    Shadow(const Light& l, const double* origin, double apart) : light(l), spread((float)apart) {
        double rows[3][3], seen[3];
        for (int k = 0; k < 3; ++k) {
            seen[k] = dot(at(l.axes, k), at(origin, 0));
            for (int j = 0; j < 3; ++j) rows[k][j] = l.axes[3 * k + j] * (k < 2 ? l.scale : 1.0);
        }
        across = every(rows[0]), down = every(rows[1]), away = every(rows[2]);
        for (int k = 0; k < 2; ++k) start[k] = (float)((seen[k] - l.low[k]) * l.scale + 4.0);
        start[2] = (float)(0.004 + 1.5 * apart * l.texel - seen[2]);
    }

    V lit(Three pos) const {
        const V column = dot(across, pos) + start[0], row = dot(down, pos) + start[1], bound = start[2] - dot(away, pos);
        const float most = light.size - 1.0f, edge = 4.0f * spread;
        const Ints on_map = (column >= -edge) & (row >= -edge) & (column <= most + edge) & (row <= most + edge);  // its rim is empty
        int32_t place[LANES];
        store(place, whole(clip(row, 0.0f, most)) / TILE * (int32_t)light.tiles + whole(clip(column, 0.0f, most)) / TILE);
        const Ints near = on_map & (looked_up(light.most, place) > bound);
        if (!any(near)) return all(1.0f);
        Ints covered{};  // less one for each probe
        for (int64_t i = 0; i < light.num_probes; ++i) {
            const V c = clip(column + spread * (float)light.probes[2 * i], 0.0f, most);
            const V r = clip(row + spread * (float)light.probes[2 * i + 1], 0.0f, most);
            store(place, whole(r) * (int32_t)light.size + whole(c));
            covered += looked_up(light.map, place) > bound;
        }
        return near ? 1.0f + real(covered) / (float)light.num_probes : all(1.0f);
    }
};

inline V power_24(V v) {
    const V square = v * v, eighth = square * square * square * square;
    return eighth * eighth * eighth;
}

// Share of the colour left by the hem's edge and its seam, smoothed over the pixel's footprint [m].
inline V sewn(V dist, V foot) {
    const V per_foot = 1.0f / foot;
    const V edge = clip((0.0025f - dist) * per_foot + 0.5f, 0.0f, 1.0f);
    const V seam = clip((0.0015f - magnitude(dist - 0.02f)) * per_foot + 0.5f, 0.0f, 1.0f) * lower(all(1.0f), 0.003f * per_foot);
    return 1.0f - 0.3f * edge - 0.35f * seam;
}

// Linear colour of a surface that is lit by these shares of the key light and of the light from all sides.
inline Three shade(const Light& light, Three normal, Three view, Three color, Three shine, V lit, V open) {
    const Three key = every(light.key);
    const V diffuse = clip((dot(normal, key) + 0.25f) / 1.25f, 0.0f, 1.0f);
    const V shadow = (0.25f + 0.75f * lit) * (0.5f + 0.5f * open);
    const V fill = clip(dot(normal, every(light.fill)), 0.0f, 1.0f);
    const V up = 0.5f + 0.5f * normal.y, facing = clip(dot(normal, view), 0.0f, 1.0f);
    const V broad = power_24(clip(dot(normal, unit(view + key)), 0.0f, 1.0f)), squared = broad * broad;
    const V gloss = (shine.x * broad + shine.y * squared * squared) * shadow;
    const V away = 1.0f - facing, bright = gloss + shine.z * away * away * away * up, dim = 0.72f + 0.28f * facing;
    const V direct = diffuse * shadow;
    const auto channel = [&](V own, int k) {
        const V around = fill * (float)light.fill_color[k] + up * (float)light.sky_color[k] + (1.0f - up) * (float)light.bounce_color[k];
        return own * (direct * (float)light.key_color[k] + open * around) * dim + bright;
    };
    return {channel(color.x, 0), channel(color.y, 1), channel(color.z, 2)};
}

}  // namespace
