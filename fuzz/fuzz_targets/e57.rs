#![no_main]

// The checksums are mended: libFuzzer would never find one.
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    adit_fuzz::read(adit_fuzz::Target::E57, &adit_fuzz::mutation::e57::mended(bytes));
});
