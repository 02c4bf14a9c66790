//! Fits Koopman operators to robot logs and writes them as blobs that a microcontroller reads.
#![doc = ""]
//! | module | what lives there |
//! |---|---|
//! | [`robot`] | `robot.toml`: the robot, its dictionary, how to fit and score |
//! | [`recording`], [`trajectory`] | logs, streamed with errors that name file, row and column; trajectories |
//! | [`snapshots`] | snapshot pairs, made by the core's own lift |
//! | [`gram`], [`solve`], [`edmd`] | the least-squares problem in constant memory |
//! | [`export`] | powers instead of Hermite polynomials, f32, the blob, files written whole |
//! | [`score`], [`arx`] | rollouts over windows beside no motion and a linear ARX |
//! | [`report`], [`inspect`], [`spectrum`], [`terms`] | what the commands print |
//! | [`topology`] | lifting functions of a topology, as in the paper's table |
//! | [`resample`] | logs on a regular time grid |

pub mod arx;
pub mod edmd;
pub mod export;
pub mod gram;
pub mod inspect;
pub mod recording;
pub mod report;
pub mod resample;
pub mod robot;
pub mod score;
pub mod snapshots;
pub mod solve;
pub mod spectrum;
pub mod terms;
pub mod topology;
pub mod trajectory;
