/* frame_quad.c - the path of a frame with one quad per vector: NEON, SSE. */
#define WIDTH 4
#include "frame_path.h"
#include "steering_path.h"

int locagen_frame_quad(const state *s, const float *in, float *correlation, float *power)
{
    return frame_path(s, in, correlation, power);
}

const locagen_steer_paths locagen_steer_quad = {
    WIDTH, listen, add_frame, add_squares, blend, soothe, invert_band, whiten_band, score_groups, place_groups,
};
