// Stateless random numbers. Source: Jarzynski and Olano, "Hash Functions for GPU Rendering",
// JCGT 2020.
#pragma once

// A 32-bit hash.
const auto pcg = [](unsigned x) {
    const unsigned state = x * 747796405u + 2891336453u;
    const unsigned word = ((state >> ((state >> 28) + 4u)) ^ state) * 277803737u;
    return (word >> 22) ^ word;
};

// The first random word of a pixel under the frame's key; further words follow by pcg(word +
// stream). The low and the high 16 bits of a word each index the table of the normal distribution.
const auto first_word = [pcg](int pixel, unsigned key_0, unsigned key_1) {
    return pcg(pcg((unsigned)pixel ^ key_0) + key_1);
};
