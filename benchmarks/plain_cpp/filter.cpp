// The filter and smoother of recon/ in plain C++, for one radar and constant errors: the limit that ours is held against.
// Same equations, same structure (transition dense in nine rows, covariance at nodes alone, Bryson-Frazier backwards),
// sizes known at compile time.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

namespace {
constexpr int N = 31, D = 27, M = 22, TRIANGLE = N * (N + 1) / 2;
constexpr double W = 7.292115e-5, GM = 3.986004418e14, J2 = 1.082629821313e-3, A = 6378137.0;

using Matrix3 = double[3][3];

void dcm(const double* q, Matrix3 c) {
  double w = q[0], x = q[1], y = q[2], z = q[3];
  c[0][0] = 1 - 2 * (y * y + z * z); c[0][1] = 2 * (x * y - w * z); c[0][2] = 2 * (x * z + w * y);
  c[1][0] = 2 * (x * y + w * z); c[1][1] = 1 - 2 * (x * x + z * z); c[1][2] = 2 * (y * z - w * x);
  c[2][0] = 2 * (x * z - w * y); c[2][1] = 2 * (y * z + w * x); c[2][2] = 1 - 2 * (x * x + y * y);
}

void turn_body(double* q, double d0, double d1, double d2) {
  double half2 = 0.25 * (d0 * d0 + d1 * d1 + d2 * d2), half = std::sqrt(half2);
  double c = std::cos(half), s = 0.5 * (half > 1e-8 ? std::sin(half) / half : 1 - half2 / 6);
  double w = q[0], x = q[1], y = q[2], z = q[3], a = s * d0, b = s * d1, e = s * d2;
  double r[4] = {w * c - x * a - y * b - z * e, w * a + x * c + y * e - z * b, w * b - x * e + y * c + z * a,
                 w * e + x * b - y * a + z * c};
  double n = 1 / std::sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2] + r[3] * r[3]);
  for (int i = 0; i < 4; ++i) q[i] = r[i] * n;
}

void turn_earth(double* q, double angle) {
  double c = std::cos(0.5 * angle), s = -std::sin(0.5 * angle), w = q[0], x = q[1], y = q[2], z = q[3];
  q[0] = c * w - s * z; q[1] = c * x - s * y; q[2] = c * y + s * x; q[3] = c * z + s * w;
}

void cross(const double* a, const double* b, double* out) {
  out[0] = a[1] * b[2] - a[2] * b[1]; out[1] = a[2] * b[0] - a[0] * b[2]; out[2] = a[0] * b[1] - a[1] * b[0];
}

void gravity(const double* p, double* g) {
  double r2 = p[0] * p[0] + p[1] * p[1] + p[2] * p[2], k = 1.5 * J2 * A * A / r2, s = 5 * p[2] * p[2] / r2;
  double m = -GM / (r2 * std::sqrt(r2));
  g[0] = m * (1 + k * (1 - s)) * p[0]; g[1] = m * (1 + k * (1 - s)) * p[1]; g[2] = m * (1 + k * (3 - s)) * p[2];
}

struct Triad {  // mean of two samples in body axes, its change, and partials by bias, scale, mount
  double value[3], change[3], partial[3][9];
  void correct(const double* before, const double* after, const double* e, const Matrix3 actual, const Matrix3 mount) {
    double in[3];
    for (int j = 0; j < 3; ++j) {
      double gain = 1 / (1 + e[3 + j]);
      in[j] = 0.5 * (before[j] + after[j]) - e[j];
      for (int i = 0; i < 3; ++i) { partial[i][j] = -actual[i][j] * gain; partial[i][3 + j] = partial[i][j] * in[j] * gain; }
    }
    for (int i = 0; i < 3; ++i) {
      value[i] = change[i] = 0;
      for (int j = 0; j < 3; ++j) { value[i] -= partial[i][j] * in[j]; change[i] -= partial[i][j] * (after[j] - before[j]); }
    }
    for (int j = 0; j < 3; ++j) {
      double axis[3] = {mount[0][j], mount[1][j], mount[2][j]}, out[3];
      cross(axis, value, out);
      for (int i = 0; i < 3; ++i) partial[i][6 + j] = out[i];
    }
  }
};

void mounting(const double* m, Matrix3 actual, Matrix3 left) {  // nominal mounting: the identity
  double q[4] = {1, 0, 0, 0};
  turn_body(q, m[0], m[1], m[2]);
  dcm(q, actual);
  double half[3][3] = {{1, -0.5 * m[2], 0.5 * m[1]}, {0.5 * m[2], 1, -0.5 * m[0]}, {-0.5 * m[1], 0.5 * m[0], 1}};
  std::memcpy(left, half, sizeof(half));
}

struct Step { double phi[9][D], noise[9][9]; };
struct Chart { double p[3], v[3], q[4], e[M]; };

void rows(double (*m)[9], bool transposed, double dt, const Matrix3 half, const Matrix3 lever) {
  auto at = [&](int i, int j) -> double& { return transposed ? m[j][i] : m[i][j]; };
  for (int j = 0; j < 9; ++j) {
    double r[3] = {at(6, j), at(7, j), at(8, j)}, t[3];
    for (int i = 0; i < 3; ++i) {
      double kick = lever[i][0] * r[0] + lever[i][1] * r[1] + lever[i][2] * r[2];
      at(i, j) += dt * (at(3 + i, j) + 0.5 * kick);
      at(3 + i, j) += kick;
    }
    for (int i = 0; i < 3; ++i) t[i] = half[0][i] * r[0] + half[1][i] * r[1] + half[2][i] * r[2];
    for (int i = 0; i < 3; ++i) at(6 + i, j) = half[0][i] * t[0] + half[1][i] * t[1] + half[2][i] * t[2];
  }
}

void columns(Step& s, double dt, const Matrix3 half, const Matrix3 mid, const Triad& f, const Triad& w, const Matrix3 g) {
  double u[3][D], push[3][D], a[3][D];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < D; ++j)
      u[i][j] = half[0][i] * s.phi[6][j] + half[1][i] * s.phi[7][j] + half[2][i] * s.phi[8][j];
  double v[3][D];
  std::memcpy(v, u, sizeof(u));
  for (int i = 0; i < 3; ++i)
    for (int j = 18; j < D; ++j) { v[i][j] += 0.5 * dt * w.partial[i][j - 18]; u[i][j] += dt * w.partial[i][j - 18]; }
  for (int i = 0; i < 3; ++i) {
    int b = (i + 1) % 3, c = (i + 2) % 3;
    for (int j = 0; j < D; ++j) push[i][j] = v[b][j] * f.value[c] - v[c][j] * f.value[b];
    for (int j = 9; j < 18; ++j) push[i][j] += f.partial[i][j - 9];
  }
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < D; ++j) {
      a[i][j] = mid[i][0] * push[0][j] + mid[i][1] * push[1][j] + mid[i][2] * push[2][j];
      for (int k = 0; k < 3; ++k) a[i][j] += g[i][k] * (s.phi[k][j] + 0.5 * dt * s.phi[3 + k][j]);
    }
  for (int j = 0; j < D; ++j) {
    double vx = s.phi[3][j] + 0.5 * dt * a[0][j], vy = s.phi[4][j] + 0.5 * dt * a[1][j];
    a[0][j] += 2 * W * vy;
    a[1][j] -= 2 * W * vx;
  }
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < D; ++j) {
      s.phi[i][j] += dt * (s.phi[3 + i][j] + 0.5 * dt * a[i][j]);
      s.phi[3 + i][j] += dt * a[i][j];
      s.phi[6 + i][j] = half[0][i] * u[0][j] + half[1][i] * u[1][j] + half[2][i] * u[2][j];
    }
}

void propagate(const double* t, const double* f, const double* w, double fd, double wd, long first, long last, Chart& c, Step& s) {
  std::memset(&s, 0, sizeof(s));
  for (int i = 0; i < 9; ++i) s.phi[i][i] = 1;
  Matrix3 fa, fl, wa, wl, half, mid, g, lever;
  mounting(c.e + 6, fa, fl);
  mounting(c.e + 15, wa, wl);
  Triad force, rate;
  for (long k = first; k < last; ++k) {
    double dt = t[k + 1] - t[k], h = 0.5 * dt;
    force.correct(f + 3 * k, f + 3 * k + 3, c.e, fa, fl);
    rate.correct(w + 3 * k, w + 3 * k + 3, c.e + 9, wa, wl);
    double *wv = rate.value, *fv = force.value, a[3], b[3], d[3];
    cross(wv, rate.change, a); cross(wv, force.change, b); cross(rate.change, fv, d);
    for (int i = 0; i < 3; ++i) { wv[i] += dt / 12 * a[i]; fv[i] += dt / 12 * (b[i] - d[i]); }
    double one[4] = {1, 0, 0, 0}, qm[4];
    turn_body(one, h * wv[0], h * wv[1], h * wv[2]);
    dcm(one, half);
    std::memcpy(qm, c.q, sizeof(qm));
    turn_body(qm, h * wv[0], h * wv[1], h * wv[2]);
    turn_earth(qm, W * h);
    dcm(qm, mid);
    std::memcpy(c.q, qm, sizeof(qm));
    turn_body(c.q, h * wv[0], h * wv[1], h * wv[2]);
    turn_earth(c.q, W * h);
    double p[3], gr[3], acc[3];
    for (int i = 0; i < 3; ++i) p[i] = c.p[i] + h * c.v[i];
    gravity(p, gr);
    for (int i = 0; i < 3; ++i) acc[i] = mid[i][0] * fv[0] + mid[i][1] * fv[1] + mid[i][2] * fv[2] + gr[i];
    acc[0] += W * W * p[0]; acc[1] += W * W * p[1];
    double vx = c.v[0] + h * (acc[0] + 2 * W * c.v[1]), vy = c.v[1] + h * (acc[1] - 2 * W * c.v[0]);
    acc[0] += 2 * W * vy; acc[1] -= 2 * W * vx;
    for (int i = 0; i < 3; ++i) { c.p[i] += dt * (c.v[i] + h * acc[i]); c.v[i] += dt * acc[i]; }
    double r2 = p[0] * p[0] + p[1] * p[1] + p[2] * p[2], m = GM / (r2 * std::sqrt(r2));
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) g[i][j] = 3 * m * p[i] * p[j] / r2;
      g[i][i] -= m;
    }
    g[0][0] += W * W; g[1][1] += W * W;
    columns(s, dt, half, mid, force, rate, g);
    for (int i = 0; i < 3; ++i) {
      double r[3] = {dt * mid[i][0], dt * mid[i][1], dt * mid[i][2]};
      lever[i][0] = r[2] * fv[1] - r[1] * fv[2]; lever[i][1] = r[0] * fv[2] - r[2] * fv[0]; lever[i][2] = r[1] * fv[0] - r[0] * fv[1];
    }
    rows(s.noise, false, dt, half, lever);
    rows(s.noise, true, dt, half, lever);
    for (int i = 0; i < 3; ++i) {
      s.noise[6 + i][6 + i] += wd * dt;
      s.noise[3 + i][3 + i] += fd * dt;
      s.noise[i][3 + i] += 0.5 * fd * dt * dt; s.noise[3 + i][i] += 0.5 * fd * dt * dt;
      s.noise[i][i] += fd * dt * dt * dt / 3;
    }
  }
}

struct Measured { bool used; double y[3], s[3][3], k[N][3], h[3][13]; };  // 9 state columns, then the radar's four errors

void radar(const Chart& c, const double* w, const double* arm, const double* site, const double* ned, double* h, double m[3][13]) {
  Matrix3 b;
  dcm(c.q, b);
  const double* e = c.e + 18;
  double turn[3], swing[3], moving[3], effective[3], point[3], x[3], tau = e[3];
  for (int i = 0; i < 3; ++i) turn[i] = w[i] - W * b[2][i];
  cross(turn, arm, swing);
  for (int i = 0; i < 3; ++i) {
    effective[i] = arm[i] - tau * swing[i];
    moving[i] = c.v[i] + b[i][0] * swing[0] + b[i][1] * swing[1] + b[i][2] * swing[2];
    point[i] = c.p[i] + b[i][0] * arm[0] + b[i][1] * arm[1] + b[i][2] * arm[2] - tau * moving[i];
  }
  for (int i = 0; i < 3; ++i) {
    x[i] = 0;
    for (int j = 0; j < 3; ++j) x[i] += ned[3 * i + j] * (point[j] - site[j]);
  }
  double level2 = x[0] * x[0] + x[1] * x[1], level = std::sqrt(level2), slant2 = level2 + x[2] * x[2], slant = std::sqrt(slant2);
  double p[3][3] = {{x[0] / slant, x[1] / slant, x[2] / slant}, {-x[1] / level2, x[0] / level2, 0},
                    {x[2] * x[0] / (slant2 * level), x[2] * x[1] / (slant2 * level), -level / slant2}};
  h[0] = slant + e[0]; h[1] = std::atan2(x[1], x[0]) + e[1]; h[2] = std::atan2(-x[2], level) + e[2];
  for (int i = 0; i < 3; ++i) {
    double row[3], r[3], lever[3];
    for (int j = 0; j < 3; ++j) r[j] = p[i][0] * ned[j] + p[i][1] * ned[3 + j] + p[i][2] * ned[6 + j];
    for (int j = 0; j < 3; ++j) row[j] = r[0] * b[0][j] + r[1] * b[1][j] + r[2] * b[2][j];
    cross(effective, row, lever);
    for (int j = 0; j < 3; ++j) { m[i][j] = r[j]; m[i][3 + j] = -tau * r[j]; m[i][6 + j] = lever[j]; m[i][9 + j] = i == j; }
    m[i][12] = -(r[0] * moving[0] + r[1] * moving[1] + r[2] * moving[2]);
  }
}

int column(int l) { return l < 9 ? l : 27 + l - 9; }

void invert(const double s[3][3], double out[3][3]) {
  double a = s[1][1] * s[2][2] - s[1][2] * s[2][1], b = s[0][2] * s[2][1] - s[0][1] * s[2][2], c = s[0][1] * s[1][2] - s[0][2] * s[1][1];
  double det = s[0][0] * a + s[1][0] * b + s[2][0] * c;
  out[0][0] = a / det; out[0][1] = out[1][0] = b / det; out[0][2] = out[2][0] = c / det;
  out[1][1] = (s[0][0] * s[2][2] - s[0][2] * s[2][0]) / det; out[2][2] = (s[0][0] * s[1][1] - s[0][1] * s[1][0]) / det;
  out[1][2] = out[2][1] = (s[0][2] * s[1][0] - s[0][0] * s[1][2]) / det;
}
}  // namespace

extern "C" void filter_and_smooth(long nodes, const long* index, const double* t, const double* f, const double* w, double fd,
                                  double wd, const double* z, const double* var, const double* site, const double* ned,
                                  const double* arm, double gate, const double* start, const double* p0, double* smoothed,
                                  double* variance) {
  std::vector<Chart> chart(nodes);
  std::vector<Step> step(nodes);
  std::vector<Measured> measured(nodes);
  std::vector<double> prior(nodes * TRIANGLE);
  std::memcpy(&chart[0], start, sizeof(Chart));
  static double p[N][N], r[9][N];
  double x[N] = {0};
  std::memcpy(p, p0, sizeof(p));
  for (long k = 0; k < nodes; ++k) {
    if (k > 0) {
      Chart c = chart[k - 1];
      for (int i = 0; i < 3; ++i) { c.p[i] += x[i]; c.v[i] += x[3 + i]; }
      turn_body(c.q, x[6], x[7], x[8]);
      for (int j = 0; j < M; ++j) c.e[j] += x[9 + j];
      Step& s = step[k - 1];
      propagate(t, f, w, fd, wd, index[k - 1], index[k], c, s);
      chart[k] = c;
      double d0 = x[6], d1 = x[7], d2 = x[8], q = d0 * d0 + d1 * d1 + d2 * d2;
      double j3[3][3] = {{1 + (d0 * d0 - q) / 6, 0.5 * d2 + d0 * d1 / 6, -0.5 * d1 + d0 * d2 / 6},
                         {-0.5 * d2 + d1 * d0 / 6, 1 + (d1 * d1 - q) / 6, 0.5 * d0 + d1 * d2 / 6},
                         {0.5 * d1 + d2 * d0 / 6, -0.5 * d0 + d2 * d1 / 6, 1 + (d2 * d2 - q) / 6}};
      for (int i = 0; i < 9; ++i) {
        double a[3] = {s.phi[i][6], s.phi[i][7], s.phi[i][8]};
        for (int j = 0; j < 3; ++j) s.phi[i][6 + j] = a[0] * j3[0][j] + a[1] * j3[1][j] + a[2] * j3[2][j];
      }
      std::memset(x, 0, sizeof(x));
      for (int i = 0; i < 9; ++i) {
        for (int j = 0; j < N; ++j) r[i][j] = 0;
        for (int l = 0; l < D; ++l)
          for (int j = 0; j < N; ++j) r[i][j] += s.phi[i][l] * p[l][j];
      }
      for (int i = 0; i < 9; ++i)
        for (int j = 0; j <= i; ++j) {
          double value = s.noise[i][j];
          for (int l = 0; l < D; ++l) value += r[i][l] * s.phi[j][l];
          p[i][j] = p[j][i] = value;
        }
      for (int i = 0; i < 9; ++i)
        for (int j = 9; j < N; ++j) p[i][j] = p[j][i] = r[i][j];
    }
    double* store = &prior[k * TRIANGLE];
    for (int i = 0; i < N; ++i)
      for (int j = 0; j <= i; ++j) *store++ = p[i][j];
    Measured& m = measured[k];
    m.used = false;
    if (std::isnan(z[3 * k])) continue;
    const Chart& c = chart[k];
    Matrix3 actual, left;
    mounting(c.e + 15, actual, left);
    double rate[3] = {0, 0, 0}, h[3], hp[3][N], si[3][3];
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) rate[i] += actual[i][j] * (w[3 * index[k] + j] - c.e[9 + j]) / (1 + c.e[12 + j]);
    radar(c, rate, arm, site, ned, h, m.h);
    for (int i = 0; i < 3; ++i) {
      m.y[i] = z[3 * k + i] - h[i];
      if (i == 1) m.y[i] -= 2 * M_PI * std::floor(m.y[i] / (2 * M_PI) + 0.5);
      for (int j = 0; j < N; ++j) hp[i][j] = 0;
      for (int l = 0; l < 13; ++l)
        for (int j = 0; j < N; ++j) hp[i][j] += m.h[i][l] * p[column(l)][j];
    }
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        m.s[i][j] = i == j ? var[3 * k + i] : 0;
        for (int l = 0; l < 13; ++l) m.s[i][j] += m.h[j][l] * hp[i][column(l)];
      }
    invert(m.s, si);
    double nis = 0;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) nis += m.y[i] * si[i][j] * m.y[j];
    if (nis > gate) continue;
    m.used = true;
    for (int i = 0; i < N; ++i) {
      for (int j = 0; j < 3; ++j) m.k[i][j] = hp[0][i] * si[0][j] + hp[1][i] * si[1][j] + hp[2][i] * si[2][j];
      x[i] += m.k[i][0] * m.y[0] + m.k[i][1] * m.y[1] + m.k[i][2] * m.y[2];
    }
    for (int i = 0; i < N; ++i)
      for (int l = 0; l < 3; ++l)
        for (int j = 0; j < N; ++j) p[i][j] -= m.k[i][l] * hp[l][j];
    for (int i = 0; i < N; ++i)
      for (int j = 0; j < i; ++j) p[i][j] = p[j][i] = 0.5 * (p[i][j] + p[j][i]);
  }
  double mean[N] = {0};
  static double info[N][N], product[N][N], u[3][N];
  std::memset(info, 0, sizeof(info));
  for (long k = nodes - 1; k >= 0; --k) {
    const Measured& m = measured[k];
    if (m.used) {
      double si[3][3], push[3], v[3][3];
      invert(m.s, si);
      for (int r3 = 0; r3 < 3; ++r3) {
        push[r3] = 0;
        for (int j = 0; j < N; ++j) { push[r3] += m.k[j][r3] * mean[j]; u[r3][j] = 0; }
        for (int j = 0; j < 3; ++j) push[r3] += si[r3][j] * m.y[j];
        for (int l = 0; l < N; ++l)
          for (int j = 0; j < N; ++j) u[r3][j] += m.k[l][r3] * info[l][j];
      }
      for (int a = 0; a < 3; ++a) {
        for (int l = 0; l < 13; ++l) mean[column(l)] -= m.h[a][l] * push[a];
        for (int b = 0; b < 3; ++b) {
          v[a][b] = si[a][b];
          for (int j = 0; j < N; ++j) v[a][b] += u[a][j] * m.k[j][b];
        }
      }
      for (int a = 0; a < 3; ++a)
        for (int j = 0; j < N; ++j)
          for (int l = 0; l < 13; ++l) info[j][column(l)] -= u[a][j] * m.h[a][l];
      for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b)
          for (int l = 0; l < 13; ++l) u[a][column(l)] -= v[a][b] * m.h[b][l];
      for (int a = 0; a < 3; ++a)
        for (int l = 0; l < 13; ++l)
          for (int j = 0; j < N; ++j) info[column(l)][j] -= m.h[a][l] * u[a][j];
      for (int i = 0; i < N; ++i)
        for (int j = 0; j < i; ++j) info[i][j] = info[j][i] = 0.5 * (info[i][j] + info[j][i]);
    }
    const double* load = &prior[k * TRIANGLE];
    for (int i = 0; i < N; ++i)
      for (int j = 0; j <= i; ++j) p[i][j] = p[j][i] = *load++;
    for (int i = 0; i < N; ++i) {
      double value = 0;
      for (int j = 0; j < N; ++j) { value += p[i][j] * mean[j]; product[i][j] = 0; }
      smoothed[k * N + i] = -value;
      for (int l = 0; l < N; ++l)
        for (int j = 0; j < N; ++j) product[i][j] += p[i][l] * info[l][j];
    }
    static double out[N][N];
    std::memcpy(out, p, sizeof(p));
    for (int i = 0; i < N; ++i) {
      for (int l = 0; l < N; ++l)
        for (int j = 0; j < N; ++j) out[i][j] -= product[i][l] * p[l][j];
      variance[k * N + i] = out[i][i];
    }
    if (k == 0) break;
    const Step& s = step[k - 1];
    double old[N];
    std::memcpy(old, mean, sizeof(old));
    for (int j = 0; j < N; ++j) {
      mean[j] = j >= 9 ? old[j] : 0;
      for (int l = 0; l < 9 && j < D; ++l) mean[j] += s.phi[l][j] * old[l];
    }
    for (int i = 0; i < N; ++i) {
      for (int j = 0; j < N; ++j) product[i][j] = j >= 9 ? info[i][j] : 0;
      for (int l = 0; l < 9; ++l)
        for (int j = 0; j < D; ++j) product[i][j] += info[i][l] * s.phi[l][j];
    }
    for (int i = 0; i < N; ++i) {
      for (int j = 0; j < N; ++j) info[i][j] = i >= 9 ? product[i][j] : 0;
      for (int l = 0; l < 9 && i < D; ++l)
        for (int j = 0; j < N; ++j) info[i][j] += s.phi[l][i] * product[l][j];
    }
  }
}
