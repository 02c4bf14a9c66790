//! What the paper's section IV did and printed: training sets, tests, dictionaries and figures. The
//! numbers here are the paper's own (Shi & Karydis 2021); everything else in the report is computed.

use crate::reproduce::Method;

/// Figures printed in the paper: one-step MSE in its units, and training time.
pub(crate) struct Published {
    pub(crate) method: Method,
    pub(crate) mse: &'static [&'static str],
    pub(crate) seconds: Option<f64>,
}

const fn published(method: Method, mse: &'static [&'static str], seconds: f64) -> Published {
    Published { method, mse, seconds: Some(seconds) }
}

const fn published_error(mse: &'static [&'static str]) -> Published {
    Published { method: Method::AcdEdmd, mse, seconds: None }
}

/// What a squared error is multiplied by to give the paper's unit, and how the paper calls it.
pub(crate) type Unit = (f64, &'static str);

/// "mm" for 1000 × m².
const MILLI: Unit = (1e3, "mm");
const METRE: Unit = (1.0, "m");
const RAD: Unit = (1.0, "rad");
/// mm² of a tip that is measured in mm.
const TIP: Unit = (1.0, "mm");

/// One test of a system.
pub(crate) struct TestCase {
    pub(crate) folder: &'static str,
    pub(crate) title: &'static str,
    pub(crate) units: &'static [Unit],
    pub(crate) published: &'static [Published],
}

/// Training data, dictionaries and tests.
pub(crate) struct System {
    pub(crate) training: &'static str,
    pub(crate) title: &'static str,
    /// The paper's dictionary.
    pub(crate) paper: &'static str,
    /// The paper's kind of dictionary over everything that is measured, where the paper leaves
    /// something out.
    pub(crate) whole: Option<&'static str>,
    /// The dictionary that this project recommends; its states are all that is measured.
    pub(crate) recommended: &'static str,
    pub(crate) tests: &'static [TestCase],
}

const DRIVE: &str = include_str!("../paper/drive.toml");
const DRIVE_SE2: &str = include_str!("../paper/drive-se2.toml");
const ROSBOT: &str = include_str!("../paper/rosbot.toml");
const ARM: &str = include_str!("../paper/arm.toml");
const ARM_VELOCITIES: &str = include_str!("../paper/arm-velocities.toml");
const ARM_RATES: &str = include_str!("../../models/two-link-arm/robot.toml");
const LEG: &str = include_str!("../paper/leg.toml");
const LEG_PARTS: &str = include_str!("../paper/leg-parts.toml");
const LEG_WALK: &str = include_str!("../paper/leg-walk.toml");

const DRIVE_UNITS: &[Unit] = &[MILLI, MILLI, RAD];
const CIRCLE: &[Published] = &[
    published(Method::Hermite, &["291.063", "110.825", "0"], 2.94),
    published(Method::EdmdDl, &["71.616", "1.119", "0.0624"], 2080.11),
    published(Method::SindyLasso, &["1.495", "1.729", "0"], 2631.00),
    published(Method::AcdEdmd, &["0.035", "0", "0.006"], 1.97),
];
const DRIVE_VALIDATION: &[Published] = &[published_error(&["0.0097", "0.0000", "0.0013"])];
const ARM_UNITS: &[Unit] = &[RAD, RAD];
const QUADRANT: &[Published] = &[
    published(Method::Hermite, &["0.0016", "0.0594"], 0.59),
    published(Method::EdmdDl, &["0.0000", "0.0000"], 280.45),
    published(Method::SindyLasso, &["0.0000", "0.0016"], 576.92),
    published(Method::AcdEdmd, &["0.0015", "0.0036"], 0.96),
];
const ARM_VALIDATION: &[Published] = &[published_error(&["0.0003", "0.0009"])];
const LEG_UNITS: &[Unit] = &[TIP, TIP];

const fn test(
    folder: &'static str,
    title: &'static str,
    units: &'static [Unit],
    published: &'static [Published],
) -> TestCase {
    TestCase { folder, title, units, published }
}

pub(crate) const SYSTEMS: &[System] = &[
    System {
        training: "drive-euler/train",
        title: "Differential drive, simulated as in the paper",
        paper: DRIVE,
        whole: None,
        recommended: DRIVE_SE2,
        tests: &[
            test("drive-euler/validation", "validation", DRIVE_UNITS, DRIVE_VALIDATION),
            test("drive-euler/circle", "circle (table II)", DRIVE_UNITS, CIRCLE),
            test(
                "rosbot/circle",
                "ROSbot, case 1: circle",
                &[METRE, METRE, RAD],
                &[published_error(&["0.0008", "0.0011", "0.0211"])],
            ),
            test(
                "rosbot/sharp-turn",
                "ROSbot, case 2: sharp turn",
                DRIVE_UNITS,
                &[published_error(&["0.0016", "0.0154", "0.0011"])],
            ),
        ],
    },
    System {
        training: "drive-closing/train",
        title: "Differential drive, simulated with the radius for which the paper's circle closes",
        paper: DRIVE,
        whole: None,
        recommended: DRIVE_SE2,
        tests: &[test("drive-closing/circle", "circle", DRIVE_UNITS, CIRCLE)],
    },
    System {
        training: "drive-exact/train",
        title: "Differential drive, exact motion",
        paper: DRIVE,
        whole: None,
        recommended: DRIVE_SE2,
        tests: &[
            test("drive-exact/validation", "validation", DRIVE_UNITS, DRIVE_VALIDATION),
            test("drive-exact/circle", "circle", DRIVE_UNITS, CIRCLE),
        ],
    },
    System {
        training: "rosbot/chattering",
        title: "ROSbot, trained on its own ten trials",
        paper: DRIVE,
        whole: None,
        recommended: ROSBOT,
        tests: &[
            test("rosbot/circle", "case 1: circle", &[METRE, METRE, RAD], &[]),
            test("rosbot/sharp-turn", "case 2: sharp turn", DRIVE_UNITS, &[]),
        ],
    },
    System {
        training: "arm-euler/train",
        title: "2R arm, simulated as in the paper",
        paper: ARM,
        whole: Some(ARM_VELOCITIES),
        recommended: ARM_RATES,
        tests: &[
            test("arm-euler/validation", "validation", ARM_UNITS, ARM_VALIDATION),
            test("arm-euler/quadrant", "quadrant (table III)", ARM_UNITS, QUADRANT),
        ],
    },
    System {
        training: "arm-rk4/train",
        title: "2R arm, integrated accurately",
        paper: ARM,
        whole: Some(ARM_VELOCITIES),
        recommended: ARM_RATES,
        tests: &[
            test("arm-rk4/validation", "validation", ARM_UNITS, ARM_VALIDATION),
            test("arm-rk4/quadrant", "quadrant", ARM_UNITS, QUADRANT),
        ],
    },
    System {
        training: "leg-bending/train",
        title: "Soft leg, case 1: bending part",
        paper: LEG,
        whole: None,
        recommended: LEG_PARTS,
        tests: &[test(
            "leg-bending/test",
            "two voltages",
            LEG_UNITS,
            &[published_error(&["0.1423", "0.0068"])],
        )],
    },
    System {
        training: "leg-extension/train",
        title: "Soft leg, case 2: extension part",
        paper: LEG,
        whole: None,
        recommended: LEG_PARTS,
        tests: &[test(
            "leg-extension/test",
            "two voltages",
            LEG_UNITS,
            &[published_error(&["0.0005", "0.0122"])],
        )],
    },
    System {
        training: "leg-walk/train",
        title: "Soft leg, case 3: whole leg",
        paper: LEG,
        whole: None,
        recommended: LEG_WALK,
        tests: &[test(
            "leg-walk/test",
            "walk (table V)",
            LEG_UNITS,
            &[
                published(Method::Hermite, &["96.357", "2.940"], 0.11),
                published(Method::EdmdDl, &["0.095", "0.013"], 151.19),
                published(Method::SindyLasso, &["0.507", "0.216"], 2.77),
                published(Method::AcdEdmd, &["0.464", "0.616"], 0.08),
            ],
        )],
    },
];
