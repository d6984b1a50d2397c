// Eigenvectors of a symmetric matrix.
#pragma once

#include "checked.h"

// Eigenvectors of a symmetric matrix as columns, eigenvalues below, by cyclic Jacobi.
auto eigen(const auto& H) {
    wp::mat_t<7, 6, wp::float64> out;
    double (&V)[7][6] = out.data;
    double A[6][6];
    for (int i = 0; i < 6; ++i)
        for (int j = 0; j < 6; ++j) {
            A[i][j] = H.data[i][j];
            V[i][j] = i == j ? 1.0 : 0.0;
        }
    for (int sweep = 0; sweep < 12; ++sweep) {
        double off = 0.0, on = 0.0;
        for (int i = 0; i < 6; ++i) {
            on += A[i][i] * A[i][i];
            for (int j = 0; j < i; ++j) off += A[i][j] * A[i][j];
        }
        if (!(off > 1e-24 * on)) break;
        for (int p = 0; p < 5; ++p)
            for (int q = p + 1; q < 6; ++q) {
                if (A[p][q] == 0.0) continue;
                const double theta = (A[q][q] - A[p][p]) / (2.0 * A[p][q]);
                const double root = sqrt(theta * theta + 1.0);
                const double t = theta >= 0.0 ? 1.0 / (theta + root) : 1.0 / (theta - root);
                const double c = 1.0 / sqrt(t * t + 1.0);
                const double s = t * c;
                for (int k = 0; k < 6; ++k) {
                    const double a = A[k][p], b = A[k][q];
                    A[k][p] = c * a - s * b;
                    A[k][q] = s * a + c * b;
                }
                for (int k = 0; k < 6; ++k) {
                    const double a = A[p][k], b = A[q][k];
                    A[p][k] = c * a - s * b;
                    A[q][k] = s * a + c * b;
                }
                for (int k = 0; k < 6; ++k) {
                    const double a = V[k][p], b = V[k][q];
                    V[k][p] = c * a - s * b;
                    V[k][q] = s * a + c * b;
                }
            }
    }
    for (int i = 0; i < 6; ++i) V[6][i] = A[i][i];
    return out;
}
