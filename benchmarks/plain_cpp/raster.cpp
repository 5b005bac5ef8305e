// Depth and nearest face of triangles through an equidistant-type fisheye lens (Kannala-Brandt): a plain z-buffer.
// Vertices are projected, edges are straight in the picture; triangles that reach beyond the field are left out.
#include <algorithm>
#include <cmath>
#include <vector>

extern "C" void raster(const double* vertices, long n, const long* faces, long m, const double* focal,
                       const double* centre, const double* k, const double* position, const double* axes,
                       double half_field, long w, long h, double* depth, long* nearest) {
    std::vector<double> u(n), v(n), d(n);
    std::vector<char> inside(n);
    const double limit = std::cos(half_field);
    for (long i = 0; i < n; ++i) {
        const double x0 = vertices[3 * i] - position[0], y0 = vertices[3 * i + 1] - position[1],
                     z0 = vertices[3 * i + 2] - position[2];
        const double x = axes[0] * x0 + axes[1] * y0 + axes[2] * z0;
        const double y = axes[3] * x0 + axes[4] * y0 + axes[5] * z0;
        const double z = axes[6] * x0 + axes[7] * y0 + axes[8] * z0;
        const double r = std::sqrt(x * x + y * y);
        d[i] = std::sqrt(r * r + z * z);
        inside[i] = z > limit * d[i];
        if (!inside[i]) continue;
        const double a = std::atan2(r, z), a2 = a * a;
        const double bent = a * (1 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3]))));
        const double s = r > 1e-12 ? bent / r : 1 / z;
        u[i] = focal[0] * s * x + centre[0];
        v[i] = focal[1] * s * y + centre[1];
    }
    for (long f = 0; f < m; ++f) {
        const long a = faces[3 * f], b = faces[3 * f + 1], c = faces[3 * f + 2];
        if (!(inside[a] && inside[b] && inside[c])) continue;
        const double ax = u[a], ay = v[a], bx = u[b], by = v[b], cx = u[c], cy = v[c];
        const double area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax);
        if (std::abs(area) < 1e-9) continue;
        const long left = std::max(0.0, std::ceil(std::min({ax, bx, cx})));
        const long right = std::min(w - 1.0, std::floor(std::max({ax, bx, cx})));
        const long top = std::max(0.0, std::ceil(std::min({ay, by, cy})));
        const long bottom = std::min(h - 1.0, std::floor(std::max({ay, by, cy})));
        if (left > right) continue;
        const double per = 1 / area, step_b = (cy - ay) * per, step_c = (ay - by) * per;
        const double slope_b = d[b] - d[a], slope_c = d[c] - d[a];
        for (long i = top; i <= bottom; ++i) {
            double share_b = ((left - ax) * (cy - ay) - (i - ay) * (cx - ax)) * per;
            double share_c = ((bx - ax) * (i - ay) - (by - ay) * (left - ax)) * per;
            for (long j = left; j <= right; ++j, share_b += step_b, share_c += step_c) {
                if (share_b < -1e-9 || share_c < -1e-9 || share_b + share_c > 1 + 1e-9) continue;
                const double here = d[a] + share_b * slope_b + share_c * slope_c;
                if (here < depth[i * w + j]) {
                    depth[i * w + j] = here;
                    nearest[i * w + j] = f;
                }
            }
        }
    }
}
