from stario.sequences.attitude.so3 import exp_and_left_jacobian


def exp_se23(xi):
    R, J = exp_and_left_jacobian(xi[..., :3])
    return R, (J @ xi[..., 3:6, None])[..., 0], (J @ xi[..., 6:9, None])[..., 0]
