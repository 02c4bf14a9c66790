//! Fits Koopman operators to robot logs and writes them as blobs that a microcontroller reads.
#![doc = ""]
//! | module | what lives there |
//! |---|---|
//! | [`robot`] | `robot.toml`: the robot, its dictionary, how to fit and score |
//! | [`recording`], [`trajectory`] | logs, streamed with errors that name file, row and column; trajectories |
//! | [`snapshots`] | snapshot pairs, made by the core's own lift |
//! | [`gram`], [`solve`], [`edmd`] | the least-squares problem in constant memory |
//! | [`chain`] | dictionaries that list their terms one by one |
//! | [`export`] | powers instead of Hermite polynomials, f32, the blob, files written whole |
//! | [`fixed_point`] | a blob's model in 32-bit integers, and how far off it is |
//! | [`score`], [`arx`], [`unicycle`] | rollouts over windows beside no motion, a linear ARX and a unicycle |
//! | [`rollout`] | rollouts in f64 or f32, and their errors over test logs |
//! | [`select`], [`library`] | the search for the best rollout that fits a controller |
//! | [`conformal`], [`cross_conformal`] | error bounds per state and step from held-out logs, or by leaving logs out |
//! | [`stability`] | the model linearised along the data; where rollouts leave the data |
//! | [`full_operator`], [`spectrum`] | the operator on the whole dictionary under held inputs; eigenvalues, eigenfunctions, modes |
//! | [`forecast`], [`koopman`], [`hermite`], [`edmd_dl`], [`sindy`] | one interface for every method, the methods |
//! | [`reproduce`], [`convergence`], [`figures`], [`plot`] | the paper's experiments, tables and figures |
//! | [`report`], [`inspect`], [`spectrum_report`], [`terms`] | what the commands print |
//! | [`topology`] | lifting functions of a topology, as in the paper's table |
//! | [`port`] | the line to a controller |
//! | [`flash`], [`exchange`] | installing a model on a controller; requests that are repeated until answered |
//! | [`monitor`] | a controller's telemetry, live and recorded |
//! | [`signing`] | keys, and signed releases of models |
//! | [`resample`] | logs on a regular time grid |

#![forbid(unsafe_code)]

pub mod arx;
pub mod chain;
pub mod conformal;
pub mod convergence;
pub mod cross_conformal;
pub mod edmd;
pub mod edmd_dl;
pub mod exchange;
pub mod export;
pub mod figures;
pub mod fixed_point;
pub mod flash;
pub mod forecast;
pub mod full_operator;
pub mod gram;
pub mod hermite;
pub mod inspect;
pub mod koopman;
pub mod library;
pub mod monitor;
mod paper;
mod paper_report;
pub mod plot;
pub mod port;
pub mod recording;
pub mod refine;
pub mod report;
pub mod reproduce;
pub mod resample;
pub mod robot;
pub mod rollout;
pub mod score;
pub mod select;
mod select_report;
pub mod signing;
pub mod sindy;
pub mod snapshots;
pub mod solve;
mod sparse_fit;
pub mod spectrum;
pub mod spectrum_report;
pub mod stability;
pub mod terms;
pub mod topology;
pub mod trajectory;
pub mod unicycle;
