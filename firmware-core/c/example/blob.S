/* The model, as `trainer fit` wrote it, at an address divisible by 4. MODEL is the file's name. */
    .section .blob, "a"
    .balign 4
    .global blob
    .global blob_end
blob:
    .incbin MODEL
blob_end:
