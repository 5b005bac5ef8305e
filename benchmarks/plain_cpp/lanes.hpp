// Numbers of several flights at once: `Lanes<n>` is n vector registers' worth, written with GCC's vector types.
#include <cmath>

#ifdef __AVX512F__
constexpr int NATIVE = 8;
#else
constexpr int NATIVE = 4;
#endif
typedef double Native __attribute__((vector_size(8 * NATIVE)));
typedef long NativeMask __attribute__((vector_size(8 * NATIVE)));

template <int n> struct Mask { NativeMask part[n]; };

template <int n> struct Lanes {
    Native part[n];
    Lanes() = default;
    Lanes(double x) {
        for (int k = 0; k < n; ++k) part[k] = Native{} + x;
    }
};

#define OPERATOR(op)                                                                                                 \
    template <int n> inline Lanes<n> operator op(const Lanes<n> &a, const Lanes<n> &b) {                             \
        Lanes<n> c;                                                                                                  \
        for (int k = 0; k < n; ++k) c.part[k] = a.part[k] op b.part[k];                                              \
        return c;                                                                                                    \
    }                                                                                                                \
    template <int n> inline Lanes<n> operator op(double a, const Lanes<n> &b) { return Lanes<n>(a) op b; }           \
    template <int n> inline Lanes<n> operator op(const Lanes<n> &a, double b) { return a op Lanes<n>(b); }
OPERATOR(+)
OPERATOR(-)
OPERATOR(*)
OPERATOR(/)
#undef OPERATOR

template <int n> inline Lanes<n> operator-(const Lanes<n> &a) { return -1.0 * a; }
template <int n> inline Lanes<n> &operator+=(Lanes<n> &a, const Lanes<n> &b) { return a = a + b; }

#define COMPARISON(op)                                                                                               \
    template <int n> inline Mask<n> operator op(const Lanes<n> &a, const Lanes<n> &b) {                              \
        Mask<n> c;                                                                                                   \
        for (int k = 0; k < n; ++k) c.part[k] = a.part[k] op b.part[k];                                              \
        return c;                                                                                                    \
    }
COMPARISON(<)
COMPARISON(>)
#undef COMPARISON

template <int n> inline Lanes<n> select(const Mask<n> &which, const Lanes<n> &a, const Lanes<n> &b) {
    Lanes<n> c;
    for (int k = 0; k < n; ++k) c.part[k] = which.part[k] ? a.part[k] : b.part[k];
    return c;
}
template <int n> inline Lanes<n> root(const Lanes<n> &x) {
    Lanes<n> y;
    for (int k = 0; k < n; ++k)
        for (int i = 0; i < NATIVE; ++i) y.part[k][i] = std::sqrt(x.part[k][i]);
    return y;
}
template <int n> inline double lane(const Lanes<n> &x, int k) { return x.part[k / NATIVE][k % NATIVE]; }
template <int n> inline void put(Lanes<n> &x, int k, double value) { x.part[k / NATIVE][k % NATIVE] = value; }

// one flight
inline double select(bool which, double a, double b) { return which ? a : b; }
inline double root(double x) { return std::sqrt(x); }
inline double lane(double x, int) { return x; }
inline void put(double &x, int, double value) { x = value; }
