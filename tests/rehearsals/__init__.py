"""Commissioning rehearsed by made-up data sheets, each with what some vendor's sheet lacks or has oddly."""
