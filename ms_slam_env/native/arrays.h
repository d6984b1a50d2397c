// Element access in contiguous arrays, without Warp's negative indices and strides; see device.py.
#pragma once

#include "checked.h"

auto fetch_number(const auto& values, int i) {
    return ELEMENT(values, i);
}

auto fetch_number_in_row(const auto& values, int row, int i) {
    return ELEMENT(values, size_t(row) * values.shape[1] + WITHIN(i, values.shape[1], "a row"));
}

auto fetch_vec3(const auto& values, int i) {
    const auto p = VIEW(const float, values, 3 * (i), 3);
    return wp::vec_t<3, float>(p[0], p[1], p[2]);
}

auto fetch_vec3_in_row(const auto& values, int row, int i) {
    const auto at = size_t(row) * values.shape[1] + WITHIN(i, values.shape[1], "a row");
    const auto p = VIEW(const float, values, 3 * at, 3);
    return wp::vec_t<3, float>(p[0], p[1], p[2]);
}

void put_number(const auto& values, int i, const auto& value) {
    ELEMENT(values, i) = value;
}

void put_number_in_row(const auto& values, int row, int i, const auto& value) {
    ELEMENT(values, size_t(row) * values.shape[1] + WITHIN(i, values.shape[1], "a row")) = value;
}

void put_vec3(const auto& values, int i, const auto& value) {
    const auto p = VIEW(float, values, 3 * (i), 3);
    p[0] = value.c[0];
    p[1] = value.c[1];
    p[2] = value.c[2];
}

void put_vec3_in_row(const auto& values, int row, int i, const auto& value) {
    const auto at = size_t(row) * values.shape[1] + WITHIN(i, values.shape[1], "a row");
    const auto p = VIEW(float, values, 3 * at, 3);
    p[0] = value.c[0];
    p[1] = value.c[1];
    p[2] = value.c[2];
}

// Raise value i to at least `value`, atomically.
void raise_to(const auto& values, int i, float value) {
    wp::atomic_max(&ELEMENT(values, i), value);
}
