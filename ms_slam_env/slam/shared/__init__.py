"""Parts that backends share: features, place recognition, alignment checks, saved states."""
