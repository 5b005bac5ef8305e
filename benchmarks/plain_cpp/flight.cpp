// The flight of synthetic_flight/dynamics.py in plain C++: the same equations, tables and constants, as a C++ author
// would write them. `Number` is a double (one flight) or `Lanes` (flights side by side; no intrinsics). `Maths` says whose atan2 and exp: the library's, or the polynomials that our kernel uses.
//
// Built and called by benchmarks/cpp_limit.py.
#include <cmath>

#include "lanes.hpp"

namespace {

template <class Number> struct Width { static constexpr int value = sizeof(Number) / sizeof(double); };

template <class N> struct Vec { N x, y, z; };
template <class N> struct Quat { N w, x, y, z; };
template <class N> struct Mat { N a, b, c, d, e, f, g, h, i; };
template <class N> struct Sym { N xx, xy, xz, yy, yz, zz; };

template <class N> Vec<N> operator+(Vec<N> p, Vec<N> q) { return {p.x + q.x, p.y + q.y, p.z + q.z}; }
template <class N> Vec<N> operator-(Vec<N> p, Vec<N> q) { return {p.x - q.x, p.y - q.y, p.z - q.z}; }
template <class N> Vec<N> operator*(N s, Vec<N> p) { return {s * p.x, s * p.y, s * p.z}; }
template <class N> N dot(Vec<N> p, Vec<N> q) { return p.x * q.x + p.y * q.y + p.z * q.z; }
template <class N> Vec<N> cross(Vec<N> p, Vec<N> q) {
    return {p.y * q.z - p.z * q.y, p.z * q.x - p.x * q.z, p.x * q.y - p.y * q.x};
}
template <class N> Vec<N> operator*(const Mat<N> &m, Vec<N> p) {
    return {m.a * p.x + m.b * p.y + m.c * p.z, m.d * p.x + m.e * p.y + m.f * p.z, m.g * p.x + m.h * p.y + m.i * p.z};
}
template <class N> Vec<N> back(const Mat<N> &m, Vec<N> p) {
    return {m.a * p.x + m.d * p.y + m.g * p.z, m.b * p.x + m.e * p.y + m.h * p.z, m.c * p.x + m.f * p.y + m.i * p.z};
}
template <class N> Vec<N> operator*(const Sym<N> &m, Vec<N> p) {
    return {m.xx * p.x + m.xy * p.y + m.xz * p.z, m.xy * p.x + m.yy * p.y + m.yz * p.z,
            m.xz * p.x + m.yz * p.y + m.zz * p.z};
}
template <class N> Sym<N> operator+(Sym<N> p, Sym<N> q) {
    return {p.xx + q.xx, p.xy + q.xy, p.xz + q.xz, p.yy + q.yy, p.yz + q.yz, p.zz + q.zz};
}
template <class N> Sym<N> turned(const Mat<N> &m, const Sym<N> &s) {
    Vec<N> r0{m.a, m.b, m.c}, r1{m.d, m.e, m.f}, r2{m.g, m.h, m.i};
    Vec<N> p = s * r0, q = s * r1, t = s * r2;
    return {dot(r0, p), dot(r1, p), dot(r2, p), dot(r1, q), dot(r2, q), dot(r2, t)};
}
template <class N> Vec<N> solved(const Sym<N> &m, Vec<N> p) {
    Sym<N> c{m.yy * m.zz - m.yz * m.yz, m.xz * m.yz - m.xy * m.zz, m.xy * m.yz - m.xz * m.yy,
             m.xx * m.zz - m.xz * m.xz, m.xy * m.xz - m.xx * m.yz, m.xx * m.yy - m.xy * m.xy};
    N per = 1.0 / (m.xx * c.xx + m.xy * c.xy + m.xz * c.xz);
    return per * (c * p);
}
template <class N> Vec<N> centripetal(Vec<N> w, Vec<N> p) { return dot(w, p) * w - dot(w, w) * p; }
template <class N> Mat<N> rotation(Quat<N> q) {
    return {1.0 - 2.0 * (q.y * q.y + q.z * q.z), 2.0 * (q.x * q.y - q.w * q.z), 2.0 * (q.x * q.z + q.w * q.y),
            2.0 * (q.x * q.y + q.w * q.z), 1.0 - 2.0 * (q.x * q.x + q.z * q.z), 2.0 * (q.y * q.z - q.w * q.x),
            2.0 * (q.x * q.z - q.w * q.y), 2.0 * (q.y * q.z + q.w * q.x), 1.0 - 2.0 * (q.x * q.x + q.y * q.y)};
}
// conjugate of p times q
template <class N> Quat<N> between(Quat<N> p, Quat<N> q) {
    return {p.w * q.w + p.x * q.x + p.y * q.y + p.z * q.z, p.w * q.x - p.x * q.w - p.y * q.z + p.z * q.y,
            p.w * q.y + p.x * q.z - p.y * q.w - p.z * q.x, p.w * q.z - p.x * q.y + p.y * q.x - p.z * q.w};
}
template <class N> Quat<N> spin(Quat<N> q, Vec<N> w) {
    return {0.5 * (-q.x * w.x - q.y * w.y - q.z * w.z), 0.5 * (q.w * w.x + q.y * w.z - q.z * w.y),
            0.5 * (q.w * w.y + q.z * w.x - q.x * w.z), 0.5 * (q.w * w.z + q.x * w.y - q.y * w.x)};
}

struct Library {
    static double angle(double y, double x) { return std::atan2(y, x); }
    static double small_exp(double x) { return std::exp(x); }
};

struct Polynomials {
    // S. L. Moshier, Cephes, atan.c
    template <class N> static N angle(N y, N x) {
        N zero = 0.0, ax = select(x < zero, -x, x), ay = select(y < zero, -y, y);
        N low = select(ax < ay, ax, ay), high = select(ax < ay, ay, ax) + 1e-300;
        auto far = low > 0.66 * high;
        N t = select(far, low - high, low) / select(far, low + high, high);
        N z = t * t;
        N p = (((-8.750608600031904122785e-1 * z - 1.615753718733365076637e1) * z - 7.500855792314704667340e1) * z -
               1.228866684490136173410e2) * z - 6.485021904942025371773e1;
        N q = ((((z + 2.485846490142306297962e1) * z + 1.650270098316988542046e2) * z + 4.328810604912902668951e2) *
               z + 4.853903996359136964868e2) * z + 1.945506571482613964425e2;
        N r = t + t * z * p / q + select(far, N(0.25 * M_PI), zero);
        r = select(ay > ax, 0.5 * M_PI - r, r);
        r = select(x < zero, M_PI - r, r);
        return select(y < zero, -r, r);
    }
    static double small_exp(double x) { return 1.0 + x * (1.0 + x / 2.0 * (1.0 + x / 3.0 * (1.0 + x / 4.0))); }
};

struct Tables {
    const double *air;  // flights x rows x 6
    const double *start_per_step_per_alpha;
    const double *mach;
    const double *coefficients;  // mach x alpha x 4
    const double *free;          // alpha x 4
    long airs, rows, machs, alphas;
};

struct Planet { double gm, j2, a, f, rate; };

// as packing.parameter_vector
template <class N> struct Vehicle {
    N m_b, m_a, per_b, per_a, share_b, share_a, per_mass;
    Sym<N> i_b, w_b, n_b, i_a, w_a, n_a;
    Vec<N> p_b, p_a, nose_a;
    N k1, k3, torsion, c1, c3, torsion_damping, freeplay, half, per_four_half, area, length, ca, cn, cm, cmq;
};

template <class N> struct State {
    Vec<N> r, v;
    Quat<N> b, a;
    Vec<N> w_b, w_a;
};

template <class N> Vec<N> gravitation(Vec<N> p, const Planet &planet) {
    N per_r2 = 1.0 / dot(p, p);
    N g = -planet.gm * root(per_r2) * per_r2;
    N k = (1.5 * planet.j2 * planet.a * planet.a) * per_r2, s = 5.0 * p.z * p.z * per_r2;
    N lateral = g * (1.0 + k * (1.0 - s));
    return {lateral * p.x, lateral * p.y, g * (1.0 + k * (3.0 - s)) * p.z};
}

template <class N> struct Place { N sin_lat, cos_lat, altitude, per_axis; };

template <class N> Place<N> geodetic(Vec<N> p, const Planet &planet) {
    double e2 = planet.f * (2.0 - planet.f);
    N p2 = p.x * p.x + p.y * p.y;
    N per_r = 1.0 / root(p2 + p.z * p.z), per_p = 1.0 / root(p2);
    N ratio = planet.a * per_r, s = p.z * per_r;
    N shrink = e2 * ratio * (1.0 + planet.f * s * s * (1.0 - 2.0 * ratio));
    N d = p2 * per_r * per_r * shrink * (2.0 - shrink);
    N grow = 1.0 + d * (0.5 + d * (0.375 + d * (0.3125 + d * (0.2734375 + d * (0.24609375 + d * 0.2255859375)))));
    N sin_lat = s * grow, p_per_cos = p2 * per_r * grow * (1.0 - shrink);
    N u = e2 * sin_lat * sin_lat;
    N curve = 1.0 - u * (0.5 + u * (0.125 + u * (0.0625 + u * (0.0390625 + u * 0.02734375))));
    return {sin_lat, p_per_cos * per_p, p_per_cos + p.z * sin_lat - planet.a * curve, per_p};
}

template <class N> struct Air { N density, sound, north, east, free; };

template <class N, class Maths> Air<N> air_at(N altitude, const Tables &t) {
    Air<N> air;
    for (int k = 0; k < Width<N>::value; ++k) {
        double u = (lane(altitude, k) - t.start_per_step_per_alpha[0]) * t.start_per_step_per_alpha[1];
        u = u > 0.0 ? u : 0.0;
        long row = u < double(t.rows - 2) ? long(u) : t.rows - 2;
        double f = u - double(row);
        f = f < 1.0 ? f : 1.0;
        const double *a = t.air + ((k < t.airs ? k : t.airs - 1) * t.rows + row) * 6, *b = a + 6;
        put(air.density, k, a[0] * Maths::small_exp(f * a[1]));
        put(air.sound, k, a[2] + f * (b[2] - a[2]));
        put(air.north, k, a[3] + f * (b[3] - a[3]));
        put(air.east, k, a[4] + f * (b[4] - a[4]));
        put(air.free, k, a[5] + f * (b[5] - a[5]));
    }
    return air;
}

template <class N> struct Coefficients { N ca, cn, cm, cmq; };

template <class N>
Coefficients<N> look_up(N mach, N alpha, N free, const Tables &t, long *brackets) {
    Coefficients<N> out;
    for (int k = 0; k < Width<N>::value; ++k) {
        double number = lane(mach, k);
        long m = brackets[k];
        while (m < t.machs - 2 && number > t.mach[m + 1]) ++m;
        while (m > 0 && number < t.mach[m]) --m;
        brackets[k] = m;
        double f = (number - t.mach[m]) / (t.mach[m + 1] - t.mach[m]);
        f = f > 0.0 ? (f < 1.0 ? f : 1.0) : 0.0;
        double u = lane(alpha, k) * t.start_per_step_per_alpha[2];
        u = u > 0.0 ? u : 0.0;
        long j = u < double(t.alphas - 2) ? long(u) : t.alphas - 2;
        double h = u - double(j), thin = lane(free, k), c[4];
        const double *low = t.coefficients + (m * t.alphas + j) * 4, *high = low + t.alphas * 4;
        for (int n = 0; n < 4; ++n) {
            double x = low[n] + h * (low[n + 4] - low[n]), y = high[n] + h * (high[n + 4] - high[n]);
            c[n] = x + f * (y - x);
        }
        if (thin > 0.0) {
            const double *molecules = t.free + j * 4;
            for (int n = 0; n < 4; ++n) {
                double x = molecules[n] + h * (molecules[n + 4] - molecules[n]);
                c[n] = c[n] + thin * (x - c[n]);
            }
        }
        put(out.ca, k, c[0]), put(out.cn, k, c[1]), put(out.cm, k, c[2]), put(out.cmq, k, c[3]);
    }
    return out;
}

// moment of the joint on the body, shell axes
template <class N, class Maths>
Vec<N> joint(const Vehicle<N> &car, const Mat<N> &c, Quat<N> twisted, Vec<N> rate) {
    N x = c.a, y = c.d, z = c.g;
    N sine = root(y * y + z * z);
    N theta = Maths::angle(sine, x);
    N zero = 0.0, from = theta - car.freeplay + car.half, outside = theta - car.freeplay - car.half;
    N inside = select(from > zero, from, zero);
    inside = select(inside < 2.0 * car.half, inside, 2.0 * car.half);
    N d = inside * inside * car.per_four_half + select(outside > zero, outside, zero);
    N k = d * (car.k1 + car.k3 * d * d) / (sine + 1e-300);
    N twist = 2.0 * Maths::angle(twisted.x, twisted.w);
    twist = select(twist > N(M_PI), twist - 2.0 * M_PI, twist);
    twist = select(twist < N(-M_PI), twist + 2.0 * M_PI, twist);
    N damping = car.c1 + car.c3 * theta * theta;
    N along = 0.5 * (rate.x * (1.0 + x) + rate.y * y + rate.z * z);
    N t = -(car.torsion * twist + (car.torsion_damping - damping) * along) / (1.0 + x);
    return {t * (1.0 + x) - damping * rate.x, k * z + t * y - damping * rate.y, t * z - k * y - damping * rate.z};
}

template <class N, class Maths>
__attribute__((flatten)) State<N> rates(const State<N> &s, const Vehicle<N> &car, const Tables &tables, const Planet &planet, long *brackets) {
    Quat<N> twisted = between(s.a, s.b);
    Mat<N> r = rotation(s.a), c = rotation(twisted);
    Vec<N> rate_b = c * s.w_b, arm_b = c * car.p_b, apart = car.p_a - arm_b;

    // the nose, the air there, the flow in shell axes
    Vec<N> nose = s.r + r * (car.nose_a + car.share_a * apart);
    Place<N> place = geodetic(nose, planet);
    Air<N> air = air_at<N, Maths>(place.altitude, tables);
    N sin_lon = nose.y * place.per_axis, cos_lon = nose.x * place.per_axis;
    Vec<N> over{s.v.x + air.north * place.sin_lat * cos_lon + air.east * sin_lon + planet.rate * nose.y,
                s.v.y + air.north * place.sin_lat * sin_lon - air.east * cos_lon - planet.rate * nose.x,
                s.v.z - air.north * place.cos_lat};
    Vec<N> flow = back(r, over) + cross(s.w_a, car.nose_a + car.share_a * car.p_a) - car.share_a * cross(rate_b, arm_b);
    N lateral2 = flow.y * flow.y + flow.z * flow.z;
    N lateral = root(lateral2), speed = root(flow.x * flow.x + lateral2);
    Coefficients<N> k =
        look_up(N(speed / air.sound), Maths::angle(lateral, flow.x), air.free, tables, brackets);
    N ca = k.ca * car.ca, cn = k.cn * car.cn, cm = k.cm * car.cm, cmq = k.cmq + car.cmq;
    N per_lateral = 1.0 / (lateral + 1e-12), ny = flow.y * per_lateral, nz = flow.z * per_lateral;
    N qs = 0.5 * air.density * speed * speed * car.area;
    N damping = 0.25 * air.density * speed * car.area * car.length * car.length * cmq, turn = qs * car.length * cm;
    Vec<N> force{-qs * ca, -qs * cn * ny, -qs * cn * nz};
    Vec<N> moment = cross(car.nose_a, force);
    moment.y += turn * nz + damping * s.w_a.y;
    moment.z += damping * s.w_a.z - turn * ny;

    // gravitation of both bodies
    Vec<N> gap = r * apart;
    Vec<N> g_b = gravitation(s.r + car.share_b * gap, planet), g_a = gravitation(s.r + car.share_a * gap, planet);
    Vec<N> tide = back(r, g_a - g_b);
    Vec<N> pull = car.per_mass * (car.m_b * g_b + car.m_a * g_a + r * force);

    // constraint force equation, shell axes
    Vec<N> hinge = joint<N, Maths>(car, c, twisted, rate_b - s.w_a);
    Vec<N> turn_b = car.w_b * (back(c, hinge) - cross(s.w_b, car.i_b * s.w_b));
    Vec<N> turn_a = car.w_a * (moment - hinge - cross(s.w_a, car.i_a * s.w_a));
    Vec<N> parting = tide + cross(turn_a, car.p_a) + centripetal(s.w_a, car.p_a) -
                     c * (cross(turn_b, car.p_b) + centripetal(s.w_b, car.p_b)) + car.per_a * force;
    Sym<N> mobility = turned(c, car.n_b) + car.n_a;
    N per = car.per_a + car.per_b;
    mobility.xx += per, mobility.yy += per, mobility.zz += per;
    Vec<N> held = solved(mobility, parting);
    turn_b = turn_b + car.w_b * cross(car.p_b, back(c, held));
    turn_a = turn_a - car.w_a * cross(car.p_a, held);
    return {s.v, pull, spin(s.b, s.w_b), spin(s.a, s.w_a), turn_b, turn_a};
}

template <class N> void normalise(Quat<N> &q) {
    N n = 1.0 / root(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
    q = {q.w * n, q.x * n, q.y * n, q.z * n};
}

template <class N> State<N> moved(const State<N> &s, double h, const State<N> &k) {
    State<N> out;
    const N *a = reinterpret_cast<const N *>(&s), *b = reinterpret_cast<const N *>(&k);
    N *c = reinterpret_cast<N *>(&out);
    for (int i = 0; i < 20; ++i) c[i] = a[i] + h * b[i];
    return out;
}

// state: 20 x flights, parameters: 67 x flights; state is replaced by the one after `steps` steps of RK4
template <class N, class Maths>
void fly(double *state, const double *parameters, const Tables &tables, const Planet &planet, double step, long steps) {
    constexpr int w = Width<N>::value;
    static_assert(sizeof(State<N>) == 20 * sizeof(N) && sizeof(Vehicle<N>) == 67 * sizeof(N));
    State<N> s;
    Vehicle<N> car;
    for (int i = 0; i < 20; ++i)
        for (int k = 0; k < w; ++k) put(reinterpret_cast<N *>(&s)[i], k, state[i * w + k]);
    for (int i = 0; i < 67; ++i)
        for (int k = 0; k < w; ++k) put(reinterpret_cast<N *>(&car)[i], k, parameters[i * w + k]);
    long brackets[w] = {};
    for (long n = 0; n < steps; ++n) {
        State<N> k = rates<N, Maths>(s, car, tables, planet, brackets);
        State<N> next = moved(s, step / 6.0, k);
        k = rates<N, Maths>(moved(s, 0.5 * step, k), car, tables, planet, brackets);
        next = moved(next, step / 3.0, k);
        k = rates<N, Maths>(moved(s, 0.5 * step, k), car, tables, planet, brackets);
        next = moved(next, step / 3.0, k);
        k = rates<N, Maths>(moved(s, step, k), car, tables, planet, brackets);
        s = moved(next, step / 6.0, k);
        normalise(s.b);
        normalise(s.a);
    }
    for (int i = 0; i < 20; ++i)
        for (int k = 0; k < w; ++k) state[i * w + k] = lane(reinterpret_cast<N *>(&s)[i], k);
}

}  // namespace

#define FLIGHT(name, Number, Maths)                                                                                  \
    extern "C" void name(double *state, const double *parameters, const Tables *tables, const Planet *planet,        \
                         double step, long steps) {                                                                  \
        fly<Number, Maths>(state, parameters, *tables, *planet, step, steps);                                        \
    }

FLIGHT(fly_library, double, Library)
FLIGHT(fly_polynomials, double, Polynomials)
FLIGHT(fly_eight, Lanes<8 / NATIVE>, Polynomials)
