"""The programs behind figures of the decision records. No command or test of the product needs them."""
