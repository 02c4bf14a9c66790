//! What has to be true of messages and frames.

use firmware_core::control_loop::telemetry::Frame;
use firmware_core::control_loop::{Alarms, Mode};
use firmware_core::link::{MAX_FRAME, Message, Received, Receiver, encode};
use firmware_core::slots::{Release, Which};
use firmware_core::update::{
    Answer, Ask, Capacities, Hello, PROTOCOL, Refused, Request, Say, Signature, Trial,
};

/// Messages of each kind, the longest ones included.
pub fn messages() -> Vec<Message> {
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
    let release = Release { length: 988, sha256: [0xA5; 32], sequence: 7, robot: 0x6B9E_3F84 };
    let signature: Signature = (0..64).collect();
    let session = u32::MAX;
    let asks = [
        Ask::Hello,
        Ask::Begin { session, release, signature: signature.clone() },
        Ask::Chunk { session, offset: 192, bytes: (0..=191).collect() },
        Ask::Verify { session },
        Ask::Activate { session, signature: signature.clone() },
        Ask::Confirm { signature: signature.clone() },
        Ask::Abort { session, signature },
    ];
    let hello = Hello {
        protocol: PROTOCOL,
        firmware: "firmware 1.2.3".chars().collect(),
        name: "a robot with a long name".chars().collect(),
        robot: u32::MAX,
        mode: Mode::Idle,
        capacities: Capacities::new::<3, 2>(u32::MAX, u32::MAX),
        which: Which::B,
        release,
        trial: Some(Trial { good: u32::MAX, needed: u32::MAX }),
        floor: u32::MAX,
        key: Some([0xFF; 8]),
    };
    let says = [
        Say::Hello(hello),
        Say::Working { most_ms: 8_000 },
        Say::Written { written: 384 },
        Say::Verified,
        Say::Refused(Refused::Busy),
        Say::Refused(Refused::TooEarly { good: 1, needed: 2 }),
    ];
    let requests = asks.map(|ask| Message::Request(Request { number: 9, ask }));
    let answers = says.map(|say| Message::Answer(Answer { number: 9, say }));
    let others = [Message::Start, Message::Stop, Message::Reset, inputs, empty, full];
    others.into_iter().chain(requests).chain(answers).collect()
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
