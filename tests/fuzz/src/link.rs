//! What has to be true of messages and frames.

use firmware_core::control_loop::telemetry::Frame;
use firmware_core::control_loop::{Alarms, Mode};
use firmware_core::link::{MAX_FRAME, Message, Received, Receiver, encode};

/// A message of each kind, the longest frame included.
pub fn messages() -> [Message; 6] {
    let numbers = || [-0.0, 1.5, f32::NAN, f32::INFINITY, 1e-40, -7.25, 0.1, 1e30].into_iter();
    let full = Frame {
        sequence: u32::MAX,
        time_us: u64::MAX,
        mode: Mode::Safe,
        alarms: Alarms::SAFE,
        noticed: Alarms::OUTLIER,
        applied: numbers().take(6).collect(),
        measured: numbers().collect(),
        predicted: numbers().collect(),
        residual: numbers().collect(),
        steps: u32::MAX,
        bound_steps: u32::MAX,
        ahead: numbers().collect(),
        worst_tick_us: u32::MAX,
        dropped: u32::MAX,
    };
    let inputs = Message::Inputs([12.0, -7.0].into_iter().collect());
    let [empty, full] = [Frame::default(), full].map(Message::Frame);
    [Message::Start, Message::Stop, Message::Reset, inputs, empty, full]
}

/// The postcard of a message: equal for two of them exactly if they are equal to the bit, NaN included.
///
/// # Panics
/// When it is longer than a frame may be.
pub fn bytes(message: &Message) -> Vec<u8> {
    let mut out = [0; MAX_FRAME];
    postcard::to_slice(message, &mut out).expect("a message is shorter than a frame").to_vec()
}

/// The frame of a message, which is whole, short enough, and received as the same message.
///
/// # Panics
/// When it is not.
pub fn frame(message: &Message) -> Vec<u8> {
    let mut out = [0; MAX_FRAME];
    let length = encode(message, &mut out).expect("MAX_FRAME bytes always are enough");
    let frame = &out[..length];
    assert_eq!(frame.iter().position(|byte| *byte == 0), Some(length - 1), "{frame:02x?}");
    let received = receive(frame);
    let [Received::Message(back)] = &received[..] else { panic!("{message:?}: {received:?}") };
    assert_eq!(bytes(back), bytes(message), "{message:?}: {back:?}");
    // A byte less is too little, and is said to be.
    assert!(encode(message, &mut [0; MAX_FRAME][..length - 1]).is_err(), "{message:?}");
    frame.to_vec()
}

/// What a new receiver makes of the bytes.
pub fn receive(bytes: &[u8]) -> Vec<Received> {
    let mut receiver = Receiver::new();
    bytes.iter().filter_map(|byte| receiver.push(*byte)).collect()
}
