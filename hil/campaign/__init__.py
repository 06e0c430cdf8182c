"""Many runs of a bench: ``from servobench import campaign``; docs/campaigns.md."""
