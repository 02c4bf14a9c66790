//! The vectors of the interrupts that the machine has. Those of any machine, which cortex-m-rt has, are 240.

core::arch::global_asm!(
    ".section .vector_table.interrupts, \"a\"",
    ".global __INTERRUPTS",
    "__INTERRUPTS:",
    concat!(".rept ", env!("INTERRUPTS")),
    ".word DefaultHandler",
    ".endr",
    ".text",
);
