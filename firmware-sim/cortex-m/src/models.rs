//! The blobs of models/, in the image's flash.

use firmware_core::blob::Aligned;

/// Those of the simulated robots.
pub static MODELS: [&Aligned<[u8]>; 4] = [
    &Aligned(*include_bytes!("../../../models/rosbot/model.bin")),
    &Aligned(*include_bytes!("../../../models/skid-rosbot/model.bin")),
    &Aligned(*include_bytes!("../../../models/soft-leg/model.bin")),
    &Aligned(*include_bytes!("../../../models/two-link-arm/model.bin")),
];
