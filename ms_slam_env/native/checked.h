// Access to Warp's arrays. In a checked build (MS_SLAM_ENV_CHECKED=1) every index is compared with
// the array's size, or with the part that a function may access; otherwise these are pointers.
//
//     ELEMENT(array, i)             element i of the flattened array
//     VIEW(T, array, first, count)  `count` values of type T starting at `first`, as a pointer
//     WITHIN(i, count, what)        index i, which must be in [0, count)
//     PACKED(T, pointer)            several values as one vector
//     RESTRICT(T)                   pointer type that does not alias others
//     GIVEN(T, name)                a constant whose value comes from Python (`native_source`)
#pragma once

#define GIVEN(T, name) constexpr T name = T(1)  // for tools that read a header alone

#if !defined(MS_SLAM_CHECKED)

#define WITHIN(i, count, what) (i)
#define ELEMENT(array, i) ((array).data[i])
#define VIEW(T, array, first, count) ((T*)(array).data + (first))
#define PACKED(T, pointer) (*(T*)(pointer))
#define RESTRICT(T) T* __restrict

#else

struct MsBounds {
    static long long within(long long i, long long low, long long high, const char* what) {
        if (i < low || i >= high) {
            printf("index %lld of %s is outside [%lld, %lld)\n", i, what, low, high);
            assert(!"index out of bounds");
        }
        return i;
    }
};
const auto ms_size = [](const auto& array) {
    long long size = 1;
    for (int k = 0; k < array.ndim; ++k) size *= array.shape[k];
    return size;
};
const auto ms_view = [](auto* data, long long size, long long first, long long count,
                         const char* what) {
    struct View {
        decltype(data) at;
        long long low, high;  // allowed indices
        const char* what;

        auto& operator[](long long i) const { return at[MsBounds::within(i, low, high, what)]; }
        View operator+(long long n) const { return {at + n, low - n, high - n, what}; }
        View& operator+=(long long n) { return *this = *this + n; }
        auto* packed(long long n) const {
            MsBounds::within(0, low, high - n + 1, what);
            return at;
        }
    };
    MsBounds::within(first, 0, size + 1, what);
    MsBounds::within(first + count, first, size + 1, what);
    return View{data + first, 0, count, what};
};

#define WITHIN(i, count, what) MsBounds::within(i, 0, count, what)
#define ELEMENT(array, i) ((array).data[MsBounds::within(i, 0, ms_size(array), #array)])
#define VIEW(T, array, first, count) \
    ms_view( \
        (T*)(array).data, ms_size(array) * (long long)(sizeof(*(array).data) / sizeof(T)), first, \
        count, #array)
#define PACKED(T, pointer) (*(T*)(pointer).packed(sizeof(T) / sizeof(*(pointer).at)))
#define RESTRICT(T) auto

#endif

// Precedes a loop with independent iterations: run eight at a time.
#if defined(__clang__) && !defined(__CUDA_ARCH__)
#define VECTORISE \
    _Pragma("clang loop vectorize(assume_safety) vectorize_width(8) interleave(disable)")
#else
#define VECTORISE
#endif
