//! Fits Koopman operators to robot logs and writes them as blobs that a microcontroller reads.
#![doc = ""]
//! | module | what lives there |
//! |---|---|
//! | [`robot`] | `robot.toml`: the robot, its dictionary, how to fit and score |
//! | [`recording`], [`trajectory`] | logs, streamed with errors that name file, row and column; trajectories |
//! | [`snapshots`] | snapshot pairs, made by the core's own lift |
//! | [`gram`], [`solve`], [`edmd`] | the least-squares problem in constant memory |
//! | [`terms`] | readable names |
//! | [`resample`] | logs on a regular time grid |

pub mod edmd;
pub mod gram;
pub mod recording;
pub mod resample;
pub mod robot;
pub mod snapshots;
pub mod solve;
pub mod terms;
pub mod trajectory;
